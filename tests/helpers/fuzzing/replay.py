"""``python -m helpers.fuzzing.replay RECIPE.json FOLDER`` writes the files of a recipe and says how the case ends."""

import json
import sys
from pathlib import Path

from helpers.fuzzing.driver import Worker

if __name__ == "__main__":
    recipe, folder = json.loads(Path(sys.argv[1]).read_text()), Path(sys.argv[2])
    folder.mkdir(parents=True, exist_ok=True)
    for mode in ("in_process", "forking"):
        worker = Worker(mode, folder)
        answer = worker.carry_out(recipe, keep=folder / mode)
        worker.close()
        print(f"{mode}: {answer['end']} {answer.get('where', '')}\n{answer.get('text', '')}")
