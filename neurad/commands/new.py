"""``neurad new``: files to begin a method, a field or a reader of one's own with."""

import argparse
import keyword
import sys
from importlib.util import find_spec
from pathlib import Path

from neurad.core.errors import InputError

TEMPLATES = Path(__file__).with_name("templates")
"""A folder for each kind of class; in its files NAME stands for the module, CLASS for the class. The first line of the
config says how to fit with it.
"""
KINDS = ("method", "field", "reader")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of the verb."""
    parser.add_argument("kind", choices=KINDS, help="what to begin")
    parser.add_argument("name", help="of its module: letters, digits and _, such as my_method")


def run(options: argparse.Namespace) -> None:
    """Write a class, a config and a test that passes into the working folder."""
    from neurad.runtime.files import write_text

    name = options.name
    if not name.isidentifier() or keyword.iskeyword(name):
        raise InputError(f"{name}: it cannot be the name of a module; letters, digits and _ can, such as my_method")
    files = sorted((TEMPLATES / options.kind).glob("*.txt"))
    paths = {Path(file.stem.replace("NAME", name)): file.read_text(encoding="utf-8") for file in files}
    if there := [str(path) for path in paths if path.exists()]:
        raise InputError(f"{', '.join(there)}: it exists; choose another name")
    if name in sys.modules or find_spec(name) is not None:
        raise InputError(f"{name}: there is a module of that name; choose another one, such as my_method")
    title = "".join(part[:1].upper() + part[1:] for part in name.split("_"))
    title = f"{title}{options.kind.title()}" if title in ("", name) else title
    written = {path: text.replace("CLASS", title).replace("NAME", name) for path, text in paths.items()}
    for path, text in written.items():
        write_text(path, text)
    print(f"neurad: wrote {', '.join(map(str, paths))}; go on with")
    print(f"  python -m pytest test_{name}.py")
    print(f"  {written[Path(f'{name}.yaml')].splitlines()[0].removeprefix('# ')}")
