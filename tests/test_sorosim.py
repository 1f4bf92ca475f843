"""Statics that others computed with SoroSim."""

import pytest

from benchmarks.sorosim_statics import RODS, compare


@pytest.mark.slow
@pytest.mark.parametrize("name", RODS)
def test_every_static_is_that_of_sorosim(name):
    """As far as the rounding of its inputs and positions goes, which alone moves the rods by up to
    0.4 mm."""
    found = compare(name)
    assert found["converged"] == found["statics"] == 250
    assert found["median [m]"] < 2e-4
    assert found["largest [m]"] < 6.5e-4
