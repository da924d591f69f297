from pathlib import Path

import pytest

from benchmarks.soak import SoakBenchmark, soak

SHIPPED = Path(__file__).parents[2] / "models" / "pointgoal1"


@pytest.mark.long
def test_a_minute_of_robots_loses_and_keeps_nothing() -> None:
    came = soak(SoakBenchmark(SHIPPED, minutes=1.0, robots=4))
    assert came.decisions > 5000
    assert came.violating_steps == 0
    assert came.faults == {}
    assert came.counted == came.recorded == came.decisions
    assert came.growth * came.decisions / 1e6 < 10.0
    assert came.complaints == ""
