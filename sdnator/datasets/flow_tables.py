"""Labelled flows as three publishers write them: one reader for each form, told by the header.

    Zeek conn.log with labels (IoT-23)  #fields ts uid id.orig_h … tunnel_parents   label   detailed-label
    binetflow (CTU-13)                  StartTime,Dur,Proto,SrcAddr,Sport,Dir,DstAddr,Dport,…,Label
    CICFlowMeter (CICIDS2017)           Flow ID, Source IP, Source Port, Destination IP, …, Label

What one has to know of them:

- IoT-23 separates the last three columns by three spaces, the others by tabs.  Labels are `Malicious` or
  `Benign`, in either case.
- CTU-13 writes local time (Prague, UTC+2 then) and the ports of ICMP in hexadecimal.  Only `From-Botnet`
  is an attack: `To-Botnet` is what others sent to the bot.
- CICIDS2017 begins most column names with a space, writes the local time (UTC-3) on a twelve-hour clock
  without AM and PM (it was recorded from 8 to 17 h: hours below 8 are afternoon), mostly without seconds,
  has lines of nothing but commas, durations of -1, and a dash of Windows-1252 in the names of web attacks.

    FlowTableError (BadInput, ValueError)
    ├── MissingFlowTable    no such file or not readable
    └── MalformedFlowTable  names the line
"""

import csv
import gzip
import ipaddress
import os
import re
import zlib
from collections.abc import Callable, Iterator, Sequence
from datetime import UTC, datetime
from functools import lru_cache
from pathlib import Path
from typing import Final, NamedTuple, TextIO

from sdnator.capture.table_file import open_table
from sdnator.errors import BadInput

MAX_LINE: Final = 65_536
"""Characters of the longest line that is read."""
_NS: Final = 1_000_000_000
_MAX_SECONDS: Final = 1 << 33
"""Later times do not fit into 64 bits of nanoseconds."""
_PROTOCOLS: Final = {"icmp": 1, "tcp": 6, "udp": 17, "ipv6-icmp": 58, "icmp6": 58}
_WITH_PORTS: Final = (6, 17)
_FIRST_MORNING_HOUR: Final = 8


class FlowTableError(BadInput, ValueError):
    """Labelled flows that cannot be used; the text says what, where and what to do."""


class MissingFlowTable(FlowTableError):
    """No such file or not readable."""


class MalformedFlowTable(FlowTableError):
    """A header or a line that is not as published."""


class LabelledFlow(NamedTuple):
    """One flow: UTC times in ns, addresses as integers, ports 0 where the protocol has none."""

    begin_ns: int
    end_ns: int
    """The last moment at which a packet of the flow may have come, as exact as the table's clock."""
    source: int
    destination: int
    source_port: int
    destination_port: int
    protocol: int
    attack: bool


def read_flow_table(
    path: str | os.PathLike[str], *, clock_offset_hours: float = 0.0
) -> Iterator[LabelledFlow]:
    """The flows of a table, plain or gzipped; flows that are not IP (ARP, for instance) are left out.

    Args:
        path: the table in one of the three forms.
        clock_offset_hours: what the table's clock is ahead of UTC; Zeek's is UTC whatever is given.

    Raises:
        MissingFlowTable, MalformedFlowTable
    """
    path = Path(path)
    # Latin-1 takes every byte: of the text only names of labels are not ASCII, and only one is looked at.
    with open_table(path, MissingFlowTable, "table", "a table of flows", encoding="latin-1") as file:
        lines = _numbered(path, file)
        try:
            yield from _flows(path, lines, round(clock_offset_hours * 3_600) * _NS)
        except (EOFError, gzip.BadGzipFile, zlib.error, csv.Error) as error:
            raise MalformedFlowTable(
                f"{path}: an incomplete table ({error}); fetch or copy it again"
            ) from None
        except OSError as error:
            raise MissingFlowTable(f"{path}: cannot be read ({error.strerror}); copy it again") from None


_Lines = Iterator[tuple[int, str]]
_Reader = Callable[[Sequence[str]], LabelledFlow | None]


def _flows(path: Path, lines: _Lines, offset_ns: int) -> Iterator[LabelledFlow]:
    for number, line in lines:
        if line.startswith("#fields"):
            yield from _read(path, lines, _zeek(path, re.split(r"\t| {2,}", line)[1:]), _zeek_cells)
            return
        if line.startswith("#"):
            continue
        names = [name.strip() for name in _csv_cells(line)]
        if "StartTime" in names:
            yield from _read(path, lines, _binetflow(path, names, offset_ns), _csv_cells)
        elif "Flow Duration" in names:
            yield from _read(path, lines, _cicflowmeter(path, names, offset_ns), _csv_cells)
        else:
            raise MalformedFlowTable(
                f"{path}: line {number:,} is not the header of a table of flows; give a conn.log.labeled of "
                "Zeek, a binetflow or a CSV of CICFlowMeter"
            )
        return
    raise MalformedFlowTable(f"{path}: no header in it; give a whole table of flows")


def _read(
    path: Path, lines: _Lines, reader: _Reader, cells: Callable[[str], list[str]]
) -> Iterator[LabelledFlow]:
    for number, line in lines:
        try:
            flow = reader(cells(line)) if line and not line.startswith("#") else None
        except (ValueError, IndexError, ArithmeticError, csv.Error) as error:
            raise MalformedFlowTable(
                f"{path}: line {number:,} is not a flow ({str(error)[:80]}); fetch or copy the table again"
            ) from None
        if flow is not None:
            yield flow


def _zeek_cells(line: str) -> list[str]:
    return re.split(r"\t| {2,}", line)


def _csv_cells(line: str) -> list[str]:
    return next(csv.reader([line]), [])


def _columns(path: Path, names: Sequence[str], *wanted: tuple[str, ...]) -> list[int]:
    """Where the wanted columns are; each has one or several names."""
    found = []
    for aliases in wanted:
        place = next((names.index(alias) for alias in aliases if alias in names), None)
        if place is None:
            raise MalformedFlowTable(
                f"{path}: no column {aliases[0]!r} in it; give the variant of the table that has addresses, "
                "times and labels (for CICIDS2017 that is GeneratedLabelledFlows, not MachineLearningCSV)"
            )
        found.append(place)
    return found


def _zeek(path: Path, names: Sequence[str]) -> _Reader:
    wanted = ("ts", "duration", "proto", "id.orig_h", "id.orig_p", "id.resp_h", "id.resp_p", "label")
    at = _columns(path, names, *((name,) for name in wanted))

    def flow(cells: Sequence[str]) -> LabelledFlow | None:
        ts, duration, proto, source, sport, destination, dport, label = (cells[i] for i in at)
        begin = _seconds_ns(ts)
        end = begin + (0 if duration in {"-", ""} else _seconds_ns(duration))
        if label.lower() not in {"malicious", "benign"}:
            raise ValueError(f"label {label!r} is neither Malicious nor Benign")
        attack = label.lower() == "malicious"
        return _flow(begin, end, source, sport, destination, dport, _PROTOCOLS.get(proto), attack)

    return flow


def _binetflow(path: Path, names: Sequence[str], offset_ns: int) -> _Reader:
    wanted = ("StartTime", "Dur", "Proto", "SrcAddr", "Sport", "DstAddr", "Dport", "Label")
    at = _columns(path, names, *((name,) for name in wanted))

    def flow(cells: Sequence[str]) -> LabelledFlow | None:
        start, duration, proto, source, sport, destination, dport, label = (cells[i] for i in at)
        protocol = _PROTOCOLS.get(proto)
        if protocol is None:  # ARP, RTP, … : no addresses or no ports that a header shows
            return None
        whole, _, fraction = start.partition(".")
        begin = _calendar(whole, "%Y/%m/%d %H:%M:%S") * _NS + _fraction_ns(fraction) - offset_ns
        end = begin + _seconds_ns(duration)
        return _flow(begin, end, source, sport, destination, dport, protocol, "From-Botnet" in label)

    return flow


def _cicflowmeter(path: Path, names: Sequence[str], offset_ns: int) -> _Reader:
    at = _columns(
        path,
        names,
        *(
            ("Timestamp",),
            ("Flow Duration",),
            ("Protocol",),
            ("Source IP", "Src IP"),
            ("Source Port", "Src Port"),
        ),
        *(("Destination IP", "Dst IP"), ("Destination Port", "Dst Port"), ("Label",)),
    )

    def flow(cells: Sequence[str]) -> LabelledFlow | None:
        if not any(cells):
            return None  # a line of nothing but commas
        stamp, duration, proto, source, sport, destination, dport, label = (cells[i].strip() for i in at)
        begin, exact = _working_hours(stamp)
        begin = begin * _NS - offset_ns
        end = begin + max(int(float(duration)), 0) * 1_000 + exact * _NS
        attack = label.upper() != "BENIGN" and not label.endswith("Attempted")
        return _flow(begin, end, source, sport, destination, dport, int(proto), attack)

    return flow


def _flow(
    begin: int,
    end: int,
    source: str,
    sport: str,
    destination: str,
    dport: str,
    proto: int | None,
    attack: bool,
) -> LabelledFlow | None:
    if proto is None:
        return None
    if not 0 <= begin <= end <= _MAX_SECONDS * _NS:
        raise ValueError("its time is out of range")
    if not 0 <= proto <= 255:
        raise ValueError(f"protocol {proto}")
    ports = (_port(sport), _port(dport)) if proto in _WITH_PORTS else (0, 0)
    return LabelledFlow(begin, end, _address(source), _address(destination), *ports, proto, attack)


@lru_cache(65_536)
def _address(text: str) -> int:
    return int(ipaddress.ip_address(text))


def _port(text: str) -> int:
    port = int(text, 16) if text.startswith("0x") else int(text or "0")
    if not 0 <= port <= 65_535:
        raise ValueError(f"port {port}")
    return port


def _seconds_ns(text: str) -> int:
    whole, _, fraction = text.partition(".")
    if not whole.isdecimal() or len(whole) > 10:
        raise ValueError(f"{text!r} is not a number of seconds")
    return int(whole) * _NS + _fraction_ns(fraction)


def _fraction_ns(text: str) -> int:
    if text and not text.isdecimal():
        raise ValueError(f"{text!r} is not a fraction of a second")
    return int(text[:9].ljust(9, "0")) if text else 0


@lru_cache(4_096)
def _calendar(text: str, form: str) -> int:
    return int(datetime.strptime(text, form).replace(tzinfo=UTC).timestamp())


@lru_cache(4_096)
def _working_hours(text: str) -> tuple[int, int]:
    """Seconds since the epoch, and how many seconds the time stands for."""
    seconds = text.count(":") == 2
    form = "%d/%m/%Y %H:%M:%S" if seconds else "%d/%m/%Y %H:%M"
    marked = text[-2:].upper() in {"AM", "PM"}
    if marked:
        form = form.replace("%H", "%I") + " %p"
    moment = _calendar(text, form)
    if not marked and moment // 3_600 % 24 < _FIRST_MORNING_HOUR:
        moment += 12 * 3_600
    return moment, 1 if seconds else 60


def _numbered(path: Path, file: TextIO) -> _Lines:
    number = 0
    while line := file.readline(MAX_LINE + 1):
        number += 1
        if len(line) > MAX_LINE:
            raise MalformedFlowTable(
                f"{path}: line {number:,} is longer than {MAX_LINE:,} characters; this is not a table of flows"
            )
        yield number, line.rstrip("\r\n")
