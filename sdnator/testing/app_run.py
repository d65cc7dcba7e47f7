"""One app's service in this process, on memory://, with stand-ins for its surroundings."""

import itertools
import os
import tempfile
import threading
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from types import ModuleType, TracebackType
from typing import Any, Self

import msgspec

from apps.messages import writer_of
from due import CONSUMER, PRODUCER, Capability, Engine, Item, Options
from due.keys import Key
from due.service import TICK_SECONDS
from sdnator.app_catalogue import service_class

_numbers: Iterator[int] = itertools.count()
_WORLD = "world"
"""App that writes keys outside the network domain, and hears all."""


class NothingWritten(AssertionError):
    """The app did not write what the test waited for; the text says what it wrote instead."""


class AppRun:
    """A started service; a context manager.

    Args:
        module: the app's module, as its entry point names it.
        app_id: under which it runs; None: the name of the module, or of its package where it is `service`.
        reliable: keys that `feed` writes reliably; all others best effort.
        archived: items that the archive holds before the app starts, as (key, value).
        settings: fields of the module's Settings.

    `tick` is called in a thread of its own, as `due.service.run` calls it in the main thread.
    """

    def __init__(
        self,
        module: ModuleType,
        *,
        app_id: str | None = None,
        reliable: Sequence[str] = (),
        archived: Sequence[tuple[str, Any]] = (),
        **settings: Any,
    ) -> None:
        self._module = module
        self._app_id = app_id or _app_id(module)
        self._reliable = reliable
        self._archived = archived
        self._settings = msgspec.convert(settings, module.Settings)
        self._url = f"memory://testing-{os.getpid()}-{next(_numbers)}"
        self._stack = ExitStack()
        self._changed = threading.Condition()
        self._written: list[Item] = []
        self._writers: dict[str, Engine] = {}
        self._app: Engine | None = None
        self._stopping = threading.Event()
        self._failure: BaseException | None = None
        self.service: Any = None
        """The app's own object, between enter and exit."""

    def __enter__(self) -> Self:
        with ExitStack() as stack:
            folder = stack.enter_context(tempfile.TemporaryDirectory(prefix="sdnator-testing-"))
            options = Options(coordinated=False, directory=folder)
            self._options = options
            self._writing = stack.enter_context(ExitStack())
            self._world = self._writer("")
            for key, value in self._archived:
                self._writer(key).write(key, value)
            for writer in self._writers.values():
                writer.flush()
            self._world.observe("**").subscribe(self._note)
            self._app = engine = self._engine(
                self._app_id,
                options,
                stack,
                interests=self._module.INTERESTS,
                capabilities=self._module.CAPABILITIES,
            )
            self.service = service_class(self._module)(engine, self._settings)
            self.service.start()
            stack.callback(self.service.stop)
            thread = threading.Thread(target=self._tick, name="app-ticks", daemon=True)
            thread.start()
            stack.callback(thread.join)
            stack.callback(self._stopping.set)
            self._stack = stack.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.close()
        if self._failure is not None and error is None:
            raise self._failure

    def feed(self, key: str, value: Any, *, event_time: int | None = None) -> None:
        """Write an item that the app may want, as the app whose name a key `network.<kind>.<app>.…` has.

        Args:
            key: a concrete key.
            value: any DUE value.
            event_time: when the described event happened, ns; None: now.
        """
        writer = self._writer(key)
        writer.write(key, value, event_time=event_time)
        writer.flush()

    def written(self, key: str = "**") -> list[Item]:
        """What the app has published so far.

        Args:
            key: under which key; wildcards are allowed.

        Returns:
            The items, in the order in which they were written.
        """
        wanted = Key.parse(key)
        with self._changed:
            return [item for item in self._written if wanted.matches(Key(item.key))]

    def wait_for(self, key: str, count: int = 1, *, seconds: float = 30.0) -> list[Item]:
        """Wait until the app has published something.

        Args:
            key: under which key; wildcards are allowed.
            count: number of items to wait for.
            seconds: how long at most.

        Returns:
            The first `count` items, as soon as they are there.

        Raises:
            NothingWritten: after `seconds`, with what the app wrote instead.
        """
        with self._changed:
            if not self._changed.wait_for(lambda: len(self.written(key)) >= count, seconds):
                others = sorted({item.key for item in self._written}) or "nothing"
                raise NothingWritten(f"{self._app_id} wrote no {count} items under {key}, but {others}")
            return self.written(key)[:count]

    def archived(self, key: str) -> list[Item]:
        """What the archive holds, whoever wrote it.

        Args:
            key: under which key; wildcards are allowed.

        Returns:
            The items, oldest first.
        """
        return self._world.get(key)

    def health(self) -> dict[str, Any]:
        """Ask the app how it is.

        Returns:
            Its health report, as the service makes it.
        """
        return dict(self.service.health())

    def _engine(self, app_id: str, options: Options, stack: ExitStack, **declared: Any) -> Engine:
        engine = Engine(options)
        engine.set_pubsub(self._url)
        engine.set_db(self._url)
        engine.init(app_id, PRODUCER | CONSUMER, **declared)
        stack.callback(engine.close)
        return engine

    def _writer(self, key: str) -> Engine:
        """The engine of the app that may write a key; apps refuse items that another app writes under it."""
        app = (writer_of(key) if key.startswith("network.") else "") or _WORLD
        if app not in self._writers:
            capabilities = [Capability(each, delivery="reliable") for each in self._reliable]
            self._writers[app] = self._engine(app, self._options, self._writing, capabilities=capabilities)
        return self._writers[app]

    def _note(self, item: Item) -> None:
        if self._app is not None and item.instance_id == self._app.instance_id:
            with self._changed:
                self._written.append(item)
                self._changed.notify_all()

    def _tick(self) -> None:
        try:
            while not self._stopping.wait(TICK_SECONDS):
                self.service.tick()
        except Exception as error:  # noqa: BLE001 - raised in the test's own thread, at the end
            self._failure = error


def _app_id(module: ModuleType) -> str:
    name = module.__name__.split(".")
    return name[-2] if name[-1] == "service" and len(name) > 1 else name[-1]
