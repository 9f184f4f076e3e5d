"""``neurad new``: files to begin a method of one's own with."""

import argparse
import keyword
import sys
from importlib.util import find_spec
from pathlib import Path

from neurad.core.errors import InputError

TEMPLATES = Path(__file__).with_name("templates")
"""Files of a method; NAME stands for its module, CLASS for its class."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of the verb."""
    parser.add_argument("kind", choices=("method",), help="what to begin")
    parser.add_argument("name", help="of its module: letters, digits and _, such as my_method")


def run(options: argparse.Namespace) -> None:
    """Write a class, a config and a test that passes into the working folder."""
    from neurad.runtime.files import write_text

    name = options.name
    if not name.isidentifier() or keyword.iskeyword(name):
        raise InputError(f"{name}: it cannot be the name of a module; letters, digits and _ can, such as my_method")
    files = sorted(TEMPLATES.glob("*.txt"))
    paths = {Path(file.stem.replace("NAME", name)): file.read_text(encoding="utf-8") for file in files}
    if there := [str(path) for path in paths if path.exists()]:
        raise InputError(f"{', '.join(there)}: it exists; choose another name")
    if name in sys.modules or find_spec(name) is not None:
        raise InputError(f"{name}: there is a module of that name; choose another one, such as my_method")
    title = "".join(part[:1].upper() + part[1:] for part in name.split("_"))
    title = f"{title}Method" if title in ("", name) else title
    for path, text in paths.items():
        write_text(path, text.replace("CLASS", title).replace("NAME", name))
    print(f"neurad: wrote {', '.join(map(str, paths))}; go on with")
    print(f"  python -m pytest test_{name}.py")
    print(f"  neurad fit --config kitchen.yaml --config {name}.yaml --trust {name}")
