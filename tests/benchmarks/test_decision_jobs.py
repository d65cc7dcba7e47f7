"""Work in copies of a process: results in order, never too much at a time, and a failure is one."""

import os
from functools import partial

import pytest

from benchmarks.decision_jobs import Jobs

# the copies use no thread of their parent
pytestmark = pytest.mark.filterwarnings("ignore:This process .* is multi-threaded:DeprecationWarning")


def test_results_come_in_the_order_of_the_work():
    assert Jobs(2).all([partial(pow, 2, number) for number in range(9)]) == [2**number for number in range(9)]


def test_no_work_is_no_result():
    assert Jobs(1).all([]) == []


def test_each_piece_of_work_has_a_process_of_its_own():
    found = Jobs(3).all([os.getpid] * 4)
    assert len({*found, os.getpid()}) == 5


def test_copies_copy_themselves_though_one_alone_works():
    """Whoever waits for copies of its own holds no token."""
    jobs = Jobs(1)

    def tree(depth):
        return 1 + sum(jobs.all([partial(tree, depth - 1)] * 2)) if depth else 1

    assert tree(3) == 15


@pytest.mark.parametrize("most", [1, 2])
def test_only_so_many_work_at_a_time(most, tmp_path):
    """Each notes how many others are at work when it begins."""
    jobs = Jobs(most)

    def work(number):
        mine = tmp_path / f"{number}"
        mine.touch()
        at_work = len(list(tmp_path.iterdir()))
        mine.unlink()
        return at_work

    assert max(jobs.all([partial(work, number) for number in range(12)])) <= most


def test_work_that_was_started_goes_on_beside_its_caller(tmp_path):
    """It gets its turn when the caller waits, at the latest; a large result does not stop it."""
    jobs = Jobs(1)
    copies = [jobs.start(partial(bytes, 1 << 20)), jobs.start(tmp_path.joinpath("done").touch)]
    assert [len(found or b"") for found in jobs.collect(copies)] == [1 << 20, 0]
    assert tmp_path.joinpath("done").exists()


def test_a_failure_ends_the_benchmark(capfd):
    with pytest.raises(SystemExit, match="a run failed"):
        Jobs(2).all([partial(int, "no number")])
    assert "no number" in capfd.readouterr().err
