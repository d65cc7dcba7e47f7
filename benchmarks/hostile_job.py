"""What one process is asked to do to one decoder, and what became of it; both travel as JSON."""

from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class Job:
    """Inputs `first` to `first + count` of one target."""

    target: str
    first: int
    count: int
    seconds: float = 1e9
    """Of the CPU, after which it stops, however many inputs are left."""
    until: float = 1e12
    """It stops at this time of the machine's monotonic clock."""
    seed: int = 1
    hang_s: float = 5.0
    """CPU seconds, or twelve times as many of the clock, after which one input hangs."""
    guided: bool = False
    """By coverage (atheris): the process must have imported the product instrumented."""
    corpus: tuple[str, ...] = ()
    """Hexadecimal; inputs that reached new code, to be mutated beside the genuine ones."""


@dataclass
class Figures:
    """What became of it."""

    inputs: int = 0
    guided: int = 0
    crashes: int = 0
    hangs: int = 0
    seconds: float = 0.0
    cpu_s: float = 0.0
    rss_first_mb: float = 0.0
    """After the first quarter of the longest run: what is made once is there by then."""
    rss_last_mb: float = 0.0
    peak_mb: float = 0.0
    findings: list[dict[str, Any]] = field(default_factory=list)
    corpus: list[str] = field(default_factory=list)

    def add(self, other: "Figures") -> None:
        """Those of another job of the same target."""
        if other.inputs >= self.inputs:
            self.rss_first_mb, self.rss_last_mb = other.rss_first_mb, other.rss_last_mb
        self.inputs += other.inputs
        self.guided += other.guided
        self.crashes += other.crashes
        self.hangs += other.hangs
        self.seconds += other.seconds
        self.cpu_s += other.cpu_s
        self.peak_mb = max(self.peak_mb, other.peak_mb)
        self.findings += other.findings
        self.corpus += other.corpus
