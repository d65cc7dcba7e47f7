"""The sender stays away from busy writers where cores are short."""

from due.sender import Pressure


def test_handing_over_the_interpreter_is_no_pressure():
    assert Pressure().felt(late=0.009) == 0.0


def test_pressure_is_bounded():
    assert Pressure().felt(late=60.0) <= 1.0


def test_one_visit_in_time_does_not_end_the_pressure_and_many_do():
    pressure = Pressure()
    felt = pressure.felt(late=0.03)
    assert 0 < pressure.felt(late=0.0) < felt
    assert min(pressure.felt(late=0.0) for _ in range(100)) < felt / 1000
