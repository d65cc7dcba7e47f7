"""Data Updates on Redis or Valkey: pub/sub for best-effort keys, streams for reliable ones."""

from due.drivers.redis_publisher import RedisPublisher
from due.drivers.redis_receiver import RedisReceiver
from due.drivers.redis_wire import client


class RedisUpdates:
    """The driver behind redis://, rediss://, unix:// and redis+sentinel:// URLs."""

    def __init__(
        self,
        url: str,
        *,
        window: int = 16 << 20,
        retain: int = 16 << 20,
        retain_s: float = 3600.0,
        group_timeout: float = 30.0,
        backlog: int = 32 << 20,
        observable: tuple[str, ...] = (),
    ) -> None:
        self.url = url
        self._observable = observable
        self._limits = (window, retain, group_timeout, retain_s)
        self._backlog = backlog
        client(url).close()  # report a wrong URL now

    def publisher(self, app: str) -> RedisPublisher:
        """A new sending half."""
        return RedisPublisher(self.url, app, self._limits)

    def receiver(self, group: str, consumer: str, *, shared: bool = False) -> RedisReceiver:
        """A new receiving half."""
        return RedisReceiver(
            self.url, group, consumer, shared=shared, backlog=self._backlog, observable=self._observable
        )

    def close(self) -> None:
        """Nothing is shared between the halves."""
