"""r2s: real-to-sim for fabrics.

Packages, each of which imports only those before it:

- `mesh`: the sheet at rest, and its strains. `environment`: air, table, grippers.
- `materials`: fabrics and their laws. `solvers`: motions of a fabric.
- `recordings`: observations, from files to one form. `scenarios`: the six experiments.
- `metrics`: distances between a simulation and a recording.
- `estimation`: fabrics from recordings. `laboratory`: fabrics from pulls, cantilevers and drapes.
- `export`, `viewer`, `study`, `cli`: other simulators, pictures, the study, the command line.

The public names are those of `__init__.pyi`. Each is imported at its first use (PEP 562), so that
`import r2s` takes no time and settings of the environment can still come before JAX. What changes
there is in the changelog.
"""

import ast
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

_STUB = ast.parse(Path(__file__).with_suffix(".pyi").read_text(encoding="utf-8"))
_HOMES = {
    alias.asname or alias.name: (str(node.module), alias.name)
    for node in _STUB.body
    if isinstance(node, ast.ImportFrom)
    for alias in node.names
}
__all__ = list(_HOMES)  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> Any:
    """Import a public name, or a module of r2s, at its first use."""
    package, attribute = _HOMES.get(name, (__name__, name))
    module = import_module(package)
    if attribute not in vars(module):
        if find_spec(f"{package}.{attribute}") is None:
            raise AttributeError(f"module {package!r} has no attribute {attribute!r}")
        import_module(f"{package}.{attribute}")
    return globals().setdefault(name, getattr(module, attribute))


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
