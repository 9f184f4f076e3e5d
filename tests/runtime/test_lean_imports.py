"""Lightning comes without what a fit does not use, and that can be imported afterwards."""

import subprocess
import sys

CODE = """
import sys
import torch
from neurad.runtime.lean_imports import import_lightning

import_lightning()
import neurad.runs.lightning
from neurad.optim.sparse_row_adam import SparseRowAdam

p = torch.nn.Parameter(torch.ones(3))
optimizer = SparseRowAdam([p], lr=0.1)
p.sum().backward()
optimizer.step()
optimizer.zero_grad()
optimizer.load_state_dict(optimizer.state_dict())
assert p.grad is None
assert abs(float(p[0]) - 0.9) < 1e-6
names = "torch._dynamo", "scipy.signal", "matplotlib", "matplotlib.pyplot"
assert not any(name in sys.modules for name in names)

import matplotlib.colors
import scipy.signal

assert matplotlib.colors.Colormap("any").name == "any"
assert len(scipy.signal.get_window("hann", 8)) == 8
"""


def test_what_lightning_imports_in_vain_is_left_out_and_can_still_be_imported():
    found = subprocess.run([sys.executable, "-c", CODE], capture_output=True, text=True, timeout=120)
    assert found.returncode == 0, found.stderr
