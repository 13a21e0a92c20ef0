"""Each planted fault still has its place in the package, and its tests are there."""

import pytest
from folders import ROOT
from plant_faults import FAULTS

SOURCE = {path: path.read_text(encoding="utf-8") for path in (ROOT / "r2s").rglob("*.py")}


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.name)
def test_the_text_of_a_fault_stands_once(fault):
    assert sum(text.count(fault.right) for text in SOURCE.values()) == 1
    assert fault.right != fault.wrong
    for name in fault.tests.split():
        assert (ROOT / "tests" / name).exists()
