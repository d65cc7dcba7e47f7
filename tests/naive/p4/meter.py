"""The oracle of the generated meters."""

GREEN, YELLOW, RED = 0, 1, 2


class Meter:
    """One two-rate three-colour marker on the packets' clock (RFC 2698, colour-blind).

    Tokens are whole; what a bucket gains up to time t is floor(t * rate / 10^6), so that no rounding adds
    up.  Time that runs backwards adds nothing.
    """

    __slots__ = ("_last", "_per_byte", "_rates", "_tokens")

    def __init__(self, *, per_byte: bool) -> None:
        self._per_byte = per_byte
        self._rates: tuple[int, int, int, int] | None = None
        self._tokens = [0, 0]
        self._last = [0, 0]

    def configure(self, rates: tuple[int, int, int, int] | None) -> None:
        """Full buckets at first; None: always green."""
        self._rates = rates
        if rates is not None:
            self._tokens = [rates[1], rates[3]]
            self._last = [0, 0]

    def execute(self, octets: int, now_us: int) -> int:
        """Colour of a packet of `octets` bytes at `now_us`."""
        if self._rates is None:
            return GREEN
        cost = octets if self._per_byte else 1
        cir, cburst, pir, pburst = self._rates
        if not self._take(1, pir, pburst, cost, now_us):
            return RED
        return GREEN if self._take(0, cir, cburst, cost, now_us) else YELLOW

    def _take(self, bucket: int, rate: int, burst: int, cost: int, now_us: int) -> bool:
        gained = now_us * rate // 1_000_000
        if gained > self._last[bucket]:
            self._tokens[bucket] = min(self._tokens[bucket] + gained - self._last[bucket], burst)
        self._last[bucket] = gained
        if self._tokens[bucket] < cost:
            return False
        self._tokens[bucket] -= cost
        return True
