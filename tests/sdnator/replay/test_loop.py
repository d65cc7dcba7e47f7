"""Who dies in a replay is named; tests/end_to_end has the replay itself."""

import pytest

from sdnator.errors import PipelineError
from sdnator.replay.loop import _name_the_dead


class Dying:
    """A pipeline whose switch has closed its sockets and is about to have ended."""

    looks = 0

    def check(self):
        self.looks += 1
        if self.looks > 3:
            raise PipelineError("switch was killed by SIGKILL")


def test_a_part_that_is_still_dying_is_waited_for():
    with pytest.raises(PipelineError, match="switch was killed"):
        _name_the_dead(Dying())
