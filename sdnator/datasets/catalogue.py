"""Public data sets by name: where they are published, under which licence, and how they are labelled.

    mirai, os_scan, …      Kitsune Network Attack Dataset: one label a packet
    iot23_1_1, …           IoT-23: Zeek's conn.log with labels, one line a connection
    ctu13_1, …             CTU-13: Argus' bidirectional flows (binetflow)
    cicids2017_tuesday, …  CICIDS2017: CICFlowMeter's CSV, one line a flow

Addresses, sizes and packet counts are those that the publishers and public scripts state.  None of the
files could be fetched while this was written (`PublicDataSet.verified`).
"""

from dataclasses import dataclass
from typing import Final, Literal

from sdnator.errors import BadInput

LabelForm = Literal["packets", "zeek", "binetflow", "cicflowmeter"]
"""One label a packet, or one label a flow in one of three forms (`sdnator.datasets.flow_tables`)."""


class UnknownDataSet(BadInput):
    """No public data set has this name."""


@dataclass(frozen=True, kw_only=True)
class Publication:
    """What all captures of one publication have in common."""

    title: str
    homepage: str
    licence: str
    citation: str
    archive: str = ""
    """Address of one archive with everything in it; empty = there is none that we can read."""
    archive_size: str = ""


@dataclass(frozen=True, kw_only=True)
class PublishedFile:
    """A file of a data set, wherever it can be had."""

    urls: tuple[str, ...]
    """Addresses, tried in this order while one is not there (404)."""
    members: tuple[str, ...] = ()
    """Names that it has inside an archive, in any folder, gzipped or not; case, spaces and `_` do not matter."""


@dataclass(frozen=True, kw_only=True)
class TrainingLength:
    """Packets at the beginning of a capture that the publication trains on."""

    fm_grace: int
    ad_grace: int


@dataclass(frozen=True, kw_only=True)
class PublicDataSet:
    """One labelled capture."""

    name: str
    title: str
    publication: Publication
    capture: PublishedFile
    labels: PublishedFile
    label_form: LabelForm
    clock_offset_hours: float = 0.0
    """What the label file's clock is ahead of UTC."""
    training: TrainingLength | None = None
    """None = the publication states none."""
    packets: int | None = None
    """As published."""
    size: str = ""
    """As published, for people."""
    note: str = ""
    verified: bool = False
    """True = the addresses were fetched and the files read by this product's authors."""


_KITSUNE: Final = Publication(
    title="Kitsune Network Attack Dataset (UCI Machine Learning Repository no. 516)",
    homepage="https://archive.ics.uci.edu/dataset/516/kitsune+network+attack+dataset",
    licence="CC BY 4.0",
    citation=(
        "Mirsky, Doitshman, Elovici, Shabtai: Kitsune: An Ensemble of Autoencoders for Online Network "
        "Intrusion Detection, NDSS 2018; https://doi.org/10.24432/C5D90Q"
    ),
    archive="https://archive.ics.uci.edu/static/public/516/kitsune+network+attack+dataset.zip",
    archive_size="17.7 GB",
)
_IOT23: Final = Publication(
    title="IoT-23: a labeled dataset with malicious and benign IoT network traffic",
    homepage="https://www.stratosphereips.org/datasets-iot23",
    licence="CC BY 4.0",
    citation=(
        "Garcia, Parmisano, Erquiaga: IoT-23, Stratosphere Laboratory, 2020; "
        "https://doi.org/10.5281/zenodo.4743746"
    ),
)
_CTU13: Final = Publication(
    title="CTU-13: a labeled dataset with botnet, normal and background traffic",
    homepage="https://www.stratosphereips.org/datasets-ctu13",
    licence="CC BY 2.0",
    citation=(
        "Garcia, Grill, Stiborek, Zunino: An empirical comparison of botnet detection methods, "
        "Computers & Security 45, 2014"
    ),
)
_CICIDS: Final = Publication(
    title="CICIDS2017: Intrusion Detection Evaluation Dataset",
    homepage="https://www.unb.ca/cic/datasets/ids-2017.html",
    licence="free for research with the citation below; the publisher may ask for registration",
    citation=(
        "Sharafaldin, Lashkari, Ghorbani: Toward Generating a New Intrusion Detection Dataset and "
        "Intrusion Traffic Characterization, ICISSP 2018"
    ),
)

_UCI: Final = "https://archive.ics.uci.edu/ml/machine-learning-databases/00516"
_STRATOSPHERE: Final = "https://mcfp.felk.cvut.cz/publicDatasets"
_CIC: Final = "http://cicresearch.ca/CICDataset/CIC-IDS-2017/Dataset/CIC-IDS-2017"
_FIRST_55_000: Final = TrainingLength(fm_grace=5_000, ad_grace=50_000)
_FIRST_MILLION: Final = TrainingLength(fm_grace=5_000, ad_grace=995_000)
_ATLANTIC_SUMMER, _CENTRAL_EUROPEAN_SUMMER = -3.0, 2.0


def _kitsune(
    folder: str, title: str, packets: int, training: TrainingLength = _FIRST_MILLION
) -> PublicDataSet:
    stem = "Mirai" if folder == "mirai" else title
    stems = (stem.replace(" ", "%20"), stem.replace(" ", "_")) if " " in stem else (stem,)
    forms = ("pcap", "pcapng") if folder in {"mirai", "ssdp_flood"} else ("pcapng", "pcap")
    captures = tuple(f"{_UCI}/{folder}/{each}_pcap.{form}.gz" for form in forms for each in stems)
    return PublicDataSet(
        name=folder,
        title=title,
        publication=_KITSUNE,
        capture=PublishedFile(urls=captures, members=(f"{stem}_pcap.pcap", f"{stem}_pcap.pcapng")),
        labels=PublishedFile(
            urls=tuple(f"{_UCI}/{folder}/{each}_labels.csv.gz" for each in stems),
            members=(f"{stem}_labels.csv",),
        ),
        label_form="packets",
        training=training,
        packets=packets,
    )


def _iot23(number: str, capture: str, about: str, size: str = "") -> PublicDataSet:
    base = f"{_STRATOSPHERE}/IoT-23-Dataset/IndividualScenarios/CTU-IoT-Malware-Capture-{number}"
    return PublicDataSet(
        name=f"iot23_{number.replace('-', '_')}",
        title=f"IoT-23, capture {number}: {about}",
        publication=_IOT23,
        capture=PublishedFile(urls=(f"{base}/{capture}",), members=(capture,)),
        labels=PublishedFile(urls=(f"{base}/bro/conn.log.labeled",), members=("conn.log.labeled",)),
        label_form="zeek",
        size=size,
        note="the device is infected from the beginning: train on another capture, then use --model",
    )


def _ctu13(number: int, day: str, malware: str) -> PublicDataSet:
    base = f"{_STRATOSPHERE}/CTU-Malware-Capture-Botnet-{number + 41}"
    capture = f"capture{day}.truncated.pcap"
    return PublicDataSet(
        name=f"ctu13_{number}",
        title=f"CTU-13, scenario {number}: {malware}",
        publication=_CTU13,
        capture=PublishedFile(urls=(f"{base}/{capture}.bz2",), members=(capture,)),
        labels=PublishedFile(
            urls=(f"{base}/detailed-bidirectional-flow-labels/capture{day}.binetflow",),
            members=(f"capture{day}.binetflow",),
        ),
        label_form="binetflow",
        clock_offset_hours=_CENTRAL_EUROPEAN_SUMMER,
        note="frames are truncated after their headers; a university's traffic, so the captures are large",
    )


def _cicids(day: str, about: str, tables: tuple[str, ...], size: str) -> PublicDataSet:
    return PublicDataSet(
        name=f"cicids2017_{day.lower()}",
        title=f"CICIDS2017, {day}: {about}",
        publication=_CICIDS,
        capture=PublishedFile(
            urls=(f"{_CIC}/PCAPs/{day}-WorkingHours.pcap",), members=(f"{day}-WorkingHours.pcap",)
        ),
        labels=PublishedFile(
            urls=(f"{_CIC}/CSVs/GeneratedLabelledFlows.zip",),
            members=tuple(f"{day}-{table}.pcap_ISCX.csv" for table in tables),
        ),
        label_form="cicflowmeter",
        clock_offset_hours=_ATLANTIC_SUMMER,
        size=size,
    )


_ALL: Final = (
    _kitsune("mirai", "Mirai Botnet", 764_137, _FIRST_55_000),
    _kitsune("os_scan", "OS Scan", 1_697_851),
    _kitsune("fuzzing", "Fuzzing", 2_244_139),
    _kitsune("video_injection", "Video Injection", 2_472_401),
    _kitsune("arp_mitm", "ARP MitM", 2_504_267),
    _kitsune("active_wiretap", "Active Wiretap", 4_554_925),
    _kitsune("ssdp_flood", "SSDP Flood", 4_077_266),
    _kitsune("syn_dos", "SYN DoS", 2_771_276),
    _kitsune("ssl_renegotiation", "SSL Renegotiation", 6_084_492),
    _iot23("1-1", "2018-05-09-192.168.100.103.pcap", "Hide and Seek", "140 MB"),
    _iot23("3-1", "2018-05-21_capture.pcap", "Muhstik"),
    _iot23("8-1", "2018-07-31-15-15-09-192.168.100.113.pcap", "Hakai"),
    _ctu13(1, "20110810", "Neris"),
    _ctu13(2, "20110811", "Neris"),
    _ctu13(5, "20110815-2", "Virut"),
    _cicids("Tuesday", "FTP and SSH password guessing", ("WorkingHours",), "11 GB"),
    _cicids("Wednesday", "denial of service, Heartbleed", ("workingHours",), "13 GB"),
    _cicids(
        "Thursday",
        "web attacks, infiltration",
        ("WorkingHours-Morning-WebAttacks", "WorkingHours-Afternoon-Infilteration"),
        "7.8 GB",
    ),
    _cicids(
        "Friday",
        "botnet, port scan, DDoS",
        ("WorkingHours-Morning", "WorkingHours-Afternoon-PortScan", "WorkingHours-Afternoon-DDos"),
        "8.3 GB",
    ),
)
CATALOGUE: Final = {each.name: each for each in _ALL}
"""Every public data set by its name."""


def public_data_set(name: str) -> PublicDataSet:
    """The data set of this name; raises UnknownDataSet."""
    try:
        return CATALOGUE[name]
    except KeyError:
        raise UnknownDataSet(
            f"no public data set is called {name!r}; `sdnator dataset list` shows all {len(CATALOGUE)}"
        ) from None
