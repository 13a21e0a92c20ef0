"""What comes with the extras of the installation, imported where it is used."""

from typing import Any


def opencv() -> Any:
    """The module cv2; `ImportError` that names the extra when it is not installed."""
    try:
        import cv2
    except ImportError as error:
        raise ImportError("images need OpenCV: pip install 'r2s[camera]'") from error
    return cv2
