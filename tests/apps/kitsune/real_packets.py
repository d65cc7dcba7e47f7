"""The real packets of the test data, for tests of Kitsune."""

from collections.abc import Iterator

from due import RecordBatch
from sdnator.testing import packet_rows
from tests.requirements import shared_data


def tsv_rows(limit: int | None = None) -> Iterator[dict[str, str]]:
    """tshark's fields of the real packets, as text."""
    return packet_rows.tsv_rows(shared_data("kitsune/mirai_38k.tsv.gz"), limit)


def real(limit: int | None = None) -> RecordBatch:
    """The real packets as a batch."""
    return packet_rows.batch_of(tsv_rows(limit))
