"""What accompanies a run: evaluation on held-out views, checkpoints, the run folder, the progress bar, a time limit."""

from neurad.callbacks.budget import TrainingBudget, WarmUp
from neurad.callbacks.checkpoint import LastCheckpoint
from neurad.callbacks.evaluation import Evaluate
from neurad.callbacks.progress import Bar
from neurad.callbacks.run_folder import RunFolder, RunLogger

__all__ = ["Bar", "Evaluate", "LastCheckpoint", "RunFolder", "RunLogger", "TrainingBudget", "WarmUp"]
