"""Libraries that come with the extras of the installation, imported where they are used."""

from importlib import import_module
from types import ModuleType


def require(module: str, extra: str, what: str) -> ModuleType:
    """Import an optional library.

    - `module`: its name, such as "cv2".
    - `extra`: the extra of r2s that installs it, such as "camera".
    - `what`: what needs it, as the subject of a sentence, such as "RGB-D images".

    Raises ImportError that names all three when it is not installed.
    """
    try:
        return import_module(module)
    except ImportError as error:
        package = module.partition(".")[0]
        raise ImportError(f"{what}: {package} is missing: pip install 'r2s[{extra}]'") from error
