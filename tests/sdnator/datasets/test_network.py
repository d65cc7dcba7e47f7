"""The house answers as a house with a dead uplink and a victim with a finite backlog does."""

from scapy.layers.inet import ICMP, IP, TCP, UDP, UDPerror
from scapy.layers.l2 import ARP as ARP_LAYER
from scapy.layers.l2 import Ether

from sdnator.datasets import frames, hosts
from sdnator.datasets.network import NetworkModel
from sdnator.datasets.traffic import ARP, ECHO, SECOND, Chance, SentPacket, WireFrame
from sdnator.datasets.traffic import TCP as TCP_KIND
from sdnator.datasets.traffic import UDP as UDP_KIND

CLOUD = hosts.CLOUD[0]


def _carry(*sent: SentPacket, cookies: bool = False) -> list[WireFrame]:
    found = list(NetworkModel(Chance(1), 200, cookies=cookies).carry(sent))
    assert [frame.time for frame in found] == sorted(frame.time for frame in found)
    return found


def test_unreachable_quotes_the_packet():
    """What goes out comes back as an ICMP error of the gateway that quotes ports and addresses."""
    sent, error = (
        Ether(frame.data) for frame in _carry(SentPacket(0, UDP_KIND, hosts.DOME, CLOUD, 82, 40_000, 10_240))
    )
    assert (error[ICMP].type, error[ICMP].code, error[IP].src, error[IP].dst) == (
        3,
        0,
        "192.168.2.1",
        "192.168.2.110",
    )
    assert (error[UDPerror].sport, error[UDPerror].dport) == (sent[UDP].sport, sent[UDP].dport)
    assert error[IP].len + 14 == 110


def test_unreachables_are_limited():
    """Six in a burst, then one a second for each asker."""
    burst = [SentPacket(n * 1000, UDP_KIND, hosts.DOME, CLOUD, 82, 1, 2) for n in range(100)]
    assert len(_carry(*burst)) == 106
    steady = [SentPacket(n * SECOND // 2, UDP_KIND, hosts.DOME, CLOUD, 82, 1, 2) for n in range(100)]
    assert 150 <= len(_carry(*steady)) <= 158


def test_arp_and_ping_and_names():
    reply = Ether(_carry(SentPacket(0, ARP, hosts.DOME, hosts.PC.ip, 60))[1].data)
    assert (reply[ARP_LAYER].op, reply[ARP_LAYER].hwsrc, reply.dst) == (
        2,
        hosts.PC.mac_text,
        hosts.DOME.mac_text,
    )
    assert len(_carry(SentPacket(0, ARP, hosts.DOME, hosts.address(hosts.ABSENT), 60))) == 1
    assert len(_carry(SentPacket(0, ARP, hosts.DOME, hosts.DOME.ip, 60))) == 1
    pong = Ether(_carry(SentPacket(0, ECHO, hosts.PC, hosts.DOME.ip, 74, number=9))[1].data)
    assert (pong[ICMP].type, pong[ICMP].seq, pong.src) == (0, 9, hosts.DOME.mac_text)
    asked = SentPacket(0, UDP_KIND, hosts.DOME, hosts.GATEWAY.ip, 80, 5_000, 53)
    assert len(_carry(asked)) == 1
    answer = Ether(_carry(asked._replace(answered=True))[1].data)
    assert (answer[UDP].sport, answer[UDP].dport, answer[IP].dst) == (53, 5_000, "192.168.2.110")


def test_groups_get_no_answer():
    assert len(_carry(SentPacket(0, UDP_KIND, hosts.DOME, hosts.SSDP_GROUP, 179, 1, 1900))) == 1


def _syn(time: int, port: int, dport: int = 80) -> SentPacket:
    bot = hosts.INFECTED
    return SentPacket(time, TCP_KIND, bot, hosts.PC.ip, 74, port, dport, frames.SYN, attacker=bot.mac_text)


def test_a_victim_answers_and_its_answers_are_benign():
    """SYN-ACK with retries from an open port, RST from a closed one and to a stray ACK."""
    found = _carry(_syn(0, 1024))
    assert [round(frame.time / SECOND) for frame in found] == [0, 0, 1, 3, 7, 15, 31]
    assert {frame.attacker for frame in found[1:]} == {""}
    assert {str(Ether(frame.data)[TCP].flags) for frame in found[1:]} == {"SA"}
    assert str(Ether(_carry(_syn(0, 1024, 81))[1].data)[TCP].flags) == "RA"
    stray = _syn(0, 1024)._replace(flags=frames.ACK, length=60)
    assert str(Ether(_carry(stray)[1].data)[TCP].flags) == "R"
    assert len(_carry(stray._replace(flags=frames.RST))) == 1
    assert len(_carry(stray._replace(answered=True))) == 1


def test_backlog_and_cookies():
    """A backlog of 256 answers so many of a thousand SYNs; with cookies all are answered."""
    flood = [_syn(n * 1000, 1024 + n) for n in range(1000)]
    assert len(_carry(*flood)) == 1000 + 256 * 6
    assert len(_carry(*flood, cookies=True)) == 2000
    later = [*flood, *(_syn(70 * SECOND + n, 1024 + n) for n in range(10))]
    assert len(_carry(*later)) == 1010 + 266 * 6


def test_a_flooded_port_answers_with_unreachables():
    bot = hosts.INFECTED
    flood = [
        SentPacket(n * 1000, UDP_KIND, bot, hosts.DOORBELL.ip, 554, 1, n + 1, attacker=bot.mac_text)
        for n in range(100)
    ]
    found = _carry(*flood)
    errors = [frame for frame in found if not frame.attacker]
    assert len(errors) == 6
    assert Ether(errors[0].data)[ICMP].code == 3
    assert errors[0].length == 14 + 20 + 8 + 540
