"""Only an ACK that acknowledges the server's number completes a handshake."""

from apps.sonata_adapter.host.handshake import Handshakes
from sdnator.testing.query_traffic import ACK, BASE_US, PSH, SYN, TimedFrame, batch_of, tcp

CLIENT, SERVER = "10.0.0.1", "192.0.2.1"


def frames(*steps):
    made = []
    for place, (who, flags, seq, ack) in enumerate(steps):
        there = (CLIENT, SERVER, 4000, 443) if who == "client" else (SERVER, CLIENT, 443, 4000)
        made.append(TimedFrame(BASE_US + place * 1000, 60, tcp(*there, flags, seq=seq, ack=ack)))
    return batch_of(made)


def test_the_third_step_completes():
    """Once, even if more ACKs follow; the sequence number wraps."""
    shakes = Handshakes()
    found = shakes.process(
        frames(
            ("client", SYN, 7, 0),
            ("server", SYN | ACK, 2**32 - 1, 8),
            ("client", ACK, 8, 0),
            ("client", ACK | PSH, 8, 0),
        )
    )
    assert [(h.source, h.service, h.port, h.at_us) for h in found] == [(CLIENT, SERVER, 443, BASE_US + 2000)]
    assert shakes.completed == 1


def test_a_spoofer_cannot_complete():
    """He does not know the server's number; the true client still can."""
    shakes = Handshakes()
    assert not shakes.process(frames(("server", SYN | ACK, 500, 8), ("client", ACK, 8, 4711)))
    assert shakes.wrong == 1
    assert len(shakes.process(frames(("client", ACK, 8, 501)))) == 1


def test_no_answer_no_handshake():
    """Where the server's direction does not pass the switch, nothing is known."""
    assert not Handshakes().process(frames(("client", SYN, 7, 0), ("client", ACK, 8, 501)))


def test_memory_is_bounded():
    """A flood's SYN-ACKs push out the oldest."""
    shakes = Handshakes(limit=10)
    flood = [
        TimedFrame(BASE_US, 60, tcp(SERVER, f"10.9.0.{n}", 443, 4000, SYN | ACK, seq=1)) for n in range(50)
    ]
    shakes.process(batch_of(flood))
    assert shakes.forgotten == 40


def test_what_is_too_old_to_be_completed_takes_no_memory():
    """Servers answer for hours, and some clients never come back: only those of the last 30 s are remembered."""
    shakes = Handshakes()
    answers = [
        TimedFrame(BASE_US + n * 1_000_000, 60, tcp(SERVER, f"10.9.0.{n}", 443, 4000, SYN | ACK, seq=1))
        for n in range(100)
    ]
    shakes.process(batch_of(answers))
    assert (len(shakes), shakes.forgotten) == (31, 0)
    late = TimedFrame(BASE_US + 100_000_000, 60, tcp("10.9.0.90", SERVER, 4000, 443, ACK, ack=2))
    assert len(shakes.process(batch_of([late]))) == 1
