"""The public names and their parameters are those of a file, so that none changes unawares.

`python tests/project/test_public_names.py` writes the file again. A change of it is a line in
CHANGELOG.md, and an old name is kept for one minor version, with a warning.
"""

import dataclasses
import inspect
from pathlib import Path

import r2s

FILE = Path(__file__).parent / "public_names.txt"


def described(name: str) -> str:
    """A public name with its parameters, fields or members."""
    value = getattr(r2s, name)
    if inspect.ismodule(value):  # presets: a function each
        made = [n for n, each in vars(value).items() if inspect.isfunction(each)]
        return f"{name}: {', '.join(sorted(n for n in made if n[0] != '_'))}"
    if isinstance(value, dict):
        return f"{name}: {', '.join(value)}"
    if inspect.isclass(value):
        fields = list(getattr(value, "_fields", getattr(value, "__members__", ())))
        if dataclasses.is_dataclass(value):
            fields = [field.name for field in dataclasses.fields(value)]
        methods = (each for each in sorted(vars(value)) if each[0] != "_" and each not in fields)
        members = ", ".join(f"{each}{parameters(value, each)}" for each in methods)
        made = fields if hasattr(value, "__members__") else inspect.signature(value).parameters
        return f"{name}({', '.join(made)}) [{', '.join(fields)}]: {members}"
    return f"{name}({', '.join(inspect.signature(value).parameters)})"


def parameters(cls: type, name: str) -> str:
    """Those of a method in brackets, without the first; of a property nothing."""
    method = inspect.getattr_static(cls, name)
    if isinstance(method, property) or not callable(getattr(cls, name)):
        return ""
    names = list(inspect.signature(getattr(cls, name)).parameters)
    bound = isinstance(method, classmethod | staticmethod)
    return f"({', '.join(names if bound else names[1:])})"


def listed() -> str:
    return "\n".join(described(name) for name in sorted(r2s.__all__)) + "\n"


def test_the_public_names_are_those_of_the_file():
    assert listed() == FILE.read_text(encoding="utf-8")


if __name__ == "__main__":
    FILE.write_text(listed(), encoding="utf-8")
