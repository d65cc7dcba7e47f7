"""Work in copies of this process, as much at a time as there are processors.

    all(works) ──fork──► a copy for each ──waits for a token──► works ──► its result comes back through a pipe

Only a copy (fork) of a process has the state of its detector, which is C's.  Copies may copy themselves: whoever
works holds one of as many tokens as there are processors, and whoever waits for copies of its own holds none.  The
tokens are bytes in a pipe, as with the job server of GNU make.
"""

import os
import pickle
import select
import sys
import traceback
from collections.abc import Callable, Sequence
from typing import Any, Final, NamedTuple

from due.drivers.embedded_redis import die_with_parent

AHEAD: Final = 2
"""Copies that one caller of `all` has at a time, for each token: one works while the next one waits for its turn."""

Work = Callable[[], Any]


class ForkedWork(NamedTuple):
    """A copy that works, or waits for its turn."""

    process: int
    pipe: int
    """Its result comes from here."""


class Jobs:
    """Copies of this process of which only some work at a time; the caller is one of those that work.

    Args:
        most: how many.
    """

    def __init__(self, most: int = os.cpu_count() or 1) -> None:
        self._most = most
        self._tokens = os.pipe()
        os.write(self._tokens[1], b"t" * (most - 1))

    def start(self, work: Work) -> ForkedWork:
        """Copy this process for one piece of work, which begins as soon as there is a token; `collect` its result."""
        reader, writer = os.pipe()
        sys.stdout.flush()  # else a copy would print what waits there, too
        process = os.fork()
        if not process:
            os.close(reader)
            self._work(work, writer)
        os.close(writer)
        return ForkedWork(process, reader)

    def collect(self, copies: Sequence[ForkedWork]) -> list[Any]:
        """The results, in order.

        Raises:
            SystemExit: one of them has failed; its traceback was printed.
        """
        if not copies:
            return []
        self._give()
        found = [_result_of(copy) for copy in copies]
        self._take()
        return found

    def all(self, works: Sequence[Work]) -> list[Any]:
        """Do each in a copy of its own, the first ones first; the results in order.

        Raises:
            SystemExit: as `collect`.
        """
        found: dict[int, Any] = {}
        going: dict[int, tuple[int, ForkedWork]] = {}
        waiting = list(enumerate(works))[::-1]
        self._give()
        while waiting or going:
            while waiting and len(going) < AHEAD * self._most:
                number, work = waiting.pop()
                copy = self.start(work)
                going[copy.pipe] = number, copy
            for pipe in select.select(list(going), [], [])[0]:
                number, copy = going.pop(pipe)
                found[number] = _result_of(copy)
        self._take()
        return [found[number] for number in range(len(works))]

    def _take(self) -> None:
        os.read(self._tokens[0], 1)

    def _give(self) -> None:
        os.write(self._tokens[1], b"t")

    def _work(self, work: Work, writer: int) -> None:
        """In the copy: work, and end; never returns."""
        die_with_parent()
        code = 1
        try:
            self._take()
            try:
                result = pickle.dumps(work())
            finally:
                self._give()  # before the result is written, which may have to wait for the reader
            with os.fdopen(writer, "wb") as pipe:
                pipe.write(result)
            code = 0
        except BaseException:  # noqa: BLE001 - the copy must not go on as if it were this process
            traceback.print_exc()
        os._exit(code)


def _result_of(copy: ForkedWork) -> Any:
    with os.fdopen(copy.pipe, "rb") as reader:
        data = reader.read()
    if os.waitpid(copy.process, 0)[1]:
        raise SystemExit("benchmarks.decisions: a run failed, see above")
    return pickle.loads(data)  # noqa: S301 - our own child's
