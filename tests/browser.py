"""A browser for the tests of pages, where there is one."""

import shutil

import pytest

BROWSER = shutil.which("chromium") or shutil.which("google-chrome")
needs_browser = pytest.mark.skipif(
    BROWSER is None, reason="neither chromium nor google-chrome is on the path"
)
