"""Programs that read what is exported: Khronos' validator on Node, and Blender in an environment of its own."""

import json
import os
import shutil
import subprocess
import sys

import pytest

VALIDATOR = "gltf-validator@2.0.0-dev.3.10"
BPY = "bpy==4.5.*"
_PYTHON = (3, 11)  # the only one that this bpy is built for
_SCRIPT = """
const {validateBytes} = require('gltf-validator'), fs = require('fs');
require('readline').createInterface({input: process.stdin}).on('line', async path => {
  const report = await validateBytes(new Uint8Array(fs.readFileSync(path)), {maxIssues: 20});
  console.log(JSON.stringify(report));
});
"""


def cache_folder(request, name):
    """A folder that is kept from one run of the tests to the next."""
    cache = getattr(request.config, "cache", None)
    return request.getfixturevalue("tmp_path_factory").mktemp(name) if cache is None else cache.mkdir(name)


class Validator:
    """Khronos' glTF validator, which answers file after file; ``folder`` gets it from the npm registry, if need be."""

    def __init__(self, folder):
        node, npm = shutil.which("node"), shutil.which("npm")
        if node is None or npm is None:
            pytest.skip("Node is missing, which runs the glTF validator")
        if not (folder / "node_modules/gltf-validator/package.json").is_file():
            words = [npm, "install", "--no-audit", "--no-fund", "--ignore-scripts", "--prefix", str(folder), VALIDATOR]
            ended = subprocess.run(words, capture_output=True, text=True, timeout=300, check=False)
            if ended.returncode != 0:
                pytest.skip(f"Node has no glTF validator, npm cannot install it: {ended.stderr[-300:]}")
        self.process = subprocess.Popen(
            [node, "-e", _SCRIPT], cwd=folder, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )

    def report(self, path):
        self.process.stdin.write(f"{path}\n")
        self.process.stdin.flush()
        return json.loads(self.process.stdout.readline())

    def issues(self, path):
        found = self.report(path)["issues"]
        assert not found["truncated"]
        return [message for message in found["messages"] if message["severity"] <= 1]

    def close(self):
        self.process.stdin.close()
        self.process.wait()


def blender_python(folder):
    """A Python that has bpy: the one that NEURAD_BLENDER names, or one in ``folder``."""
    if "NEURAD_BLENDER" in os.environ:
        return os.environ["NEURAD_BLENDER"]
    name = "python{}.{}".format(*_PYTHON)
    base = sys.executable if sys.version_info[:2] == _PYTHON else shutil.which(name)
    if base is None:
        pytest.skip(f"there is no {name} to install bpy for")
    python = folder / "bin/python"
    if not list(folder.glob("lib/python*/site-packages/bpy")):
        subprocess.run([base, "-m", "venv", str(folder)], check=True)
        subprocess.run([str(python), "-m", "pip", "install", "-q", BPY], check=True)
    return str(python)
