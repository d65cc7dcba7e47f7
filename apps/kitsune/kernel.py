"""Loads the C kernel: features, autoencoders and trackers of packets."""

import functools
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final, NamedTuple

import cffi
import numpy as np
import numpy.typing as npt

LAMBDAS: Final = (5.0, 3.0, 1.0, 0.1, 0.01)
"""Damping factors of the five time scales, per second."""

Columns = Mapping[str, npt.NDArray[Any]]
"""A record batch, or the columns of one."""

VERSION: Final = 11
"""Version of the C interface, compared with that of the library."""

_LIBRARY: Final = Path(__file__).with_name("_kernel.so")

SOURCES: Final = tuple(
    Path(__file__).with_name(f"{part}.c")
    for part in ("afterimage", "kitnet", "behaviour", "senders", "victims")
)
"""What the library is built from."""

PACKET_FIELDS: Final[tuple[tuple[str, str, str], ...]] = (
    ("length", "uint32_t", "u4"),
    ("time", "double", "f8"),
    ("eth_src", "uint64_t", "u8"),
    ("eth_dst", "uint64_t", "u8"),
    ("arp_op", "int32_t", "i4"),
    ("arp_src_ip", "uint32_t", "u4"),
    ("arp_dst_ip", "uint32_t", "u4"),
    ("ip_version", "uint8_t", "u1"),
    ("ip_src_hi", "uint64_t", "u8"),
    ("ip_src_lo", "uint64_t", "u8"),
    ("ip_dst_hi", "uint64_t", "u8"),
    ("ip_dst_lo", "uint64_t", "u8"),
    ("tcp_sport", "int32_t", "i4"),
    ("tcp_dport", "int32_t", "i4"),
    ("udp_sport", "int32_t", "i4"),
    ("udp_dport", "int32_t", "i4"),
    ("icmp_type", "int32_t", "i4"),
)
"""Columns from which features are computed: name, C type, numpy type. `time` is in seconds."""

ROW_FIELDS: Final[tuple[tuple[str, str, str], ...]] = (
    *PACKET_FIELDS,
    ("arrival", "uint64_t", "u8"),
    ("port", "uint16_t", "u2"),
    ("quoted", "uint8_t", "u1"),
    ("tcp_flags", "uint8_t", "u1"),
    ("icmp6_type", "int32_t", "i4"),
)
"""Columns that the trackers read, in the order of `PacketRows` in C, which begins with those of `Columns`."""

_TRACKERS: Final = (
    "typedef struct {"
    + "".join(f"const {c_type} *{name};" for name, c_type, _ in ROW_FIELDS)
    + """} PacketRows;
    typedef struct Row Row;
    void seconds_of(const int64_t *nanoseconds, long n, double *out);
    long row_bytes(void);
    void rows_read(const PacketRows *, long n, Row *);
    long scores_over(const double *scores, long first, long last, double threshold);
    long rows_benign(const Row *, long first, long last, const double *scores, double threshold, const uint64_t *macs,
                     long m, double *out);
    long rows_marked(const PacketRows *, const uint32_t *sequence, long n, long trained, long most, int32_t *rows,
                     int32_t *by, int32_t *senders, int64_t *out);
    typedef struct { uint64_t mac, source; double newest; int32_t port, first, count; } MarkedSender;
    void marked_senders(const PacketRows *, const int64_t *time_us, long found, const int32_t *rows, const int32_t *by,
                        long count, const int32_t *senders, MarkedSender *out, double *times);
    typedef struct {
        int32_t most_subjects, kept, most_contacts, calibration;
        double grace_s, least_nats, most_nats, least_step, least_share, deciding_nats, half_life_s,
            neighbours_share, least_scale_share, asked_s, present_s, theft, again_s, soon_s, in_vain_s;
        int32_t refused_bytes, replies_count, chosen, blocks, most_logins, others;
    } BehaviourLimits;
    typedef struct { int32_t windows, own, rates; double window[4], least_scale; } CounterSettings;
    typedef struct {
        int32_t what, block;
        uint64_t who[4], victim[2];
        int64_t service;
        uint64_t kind;
        double nats, total, count, window, usual, begun, time;
        uint64_t arrival;
        int32_t has_sender, supporting;
        double sums[4];
    } BehaviourEvent;
    typedef struct Behaviour Behaviour;
    Behaviour *behaviour_new(const BehaviourLimits *, const CounterSettings *, int64_t per_block,
                             const uint16_t *logins, long n, uint64_t seed);
    void behaviour_free(Behaviour *);
    int behaviour_add(Behaviour *, const Row *, long n, long first, long last, uint16_t number,
                      const double *scores, const double *logs, double threshold);
    int behaviour_calibrate(Behaviour *, const double *logs, long n, int32_t blocks);
    const BehaviourEvent *behaviour_events(const Behaviour *, long *count);
    long behaviour_tail(const Behaviour *);
    long behaviour_subjects(const Behaviour *);
    void behaviour_training(const Behaviour *, double *out);
    void behaviour_close_training(Behaviour *);
    int behaviour_baseline(Behaviour *, int32_t what, int32_t own, const uint64_t *keys, const double *counts, long n);
    int behaviour_scales(Behaviour *, int32_t what, int32_t usable, double own, double shared, double rarity);
    int behaviour_know(Behaviour *, const uint64_t *senders, long n, const uint64_t *owners, long m,
                       const uint64_t *contacts, long k);
    long behaviour_contacts(const Behaviour *, int32_t training, uint64_t *out, long room);
    void behaviour_callbacks(Behaviour *, double nats, double usual);
    void behaviour_outside(Behaviour *, double silence, int32_t reached);
    void behaviour_arp_grace(Behaviour *, double seconds);
    int behaviour_proven(const Behaviour *, int32_t six, uint64_t hi, uint64_t lo);
    int behaviour_blocks(Behaviour *, const uint64_t *rows, long n);
    typedef struct {
        int64_t most_senders;
        int32_t most_conversations, anomalous_packets, replies_per_packet;
        double anomalous_share;
    } SenderLimits;
    typedef struct {
        int32_t what, kept_in, kept_at, row;
        uint64_t who[4];
        int64_t second, packets, over, destinations; uint64_t first_over; int64_t training_rate, training_destinations;
        double peak;
    } SenderEvent;
    typedef struct Senders Senders;
    Senders *senders_new(const SenderLimits *, int32_t training, uint64_t seed);
    void senders_free(Senders *);
    int senders_add(Senders *, const Row *, long n, long trained, uint16_t number, const double *scores,
                    double threshold, int32_t *peaks, long *kept);
    int senders_finish(Senders *);
    const SenderEvent *senders_events(const Senders *, long *count);
    int senders_know(Senders *, const uint64_t *who, int64_t rate, int64_t destinations);
    long senders_known(const Senders *, uint64_t *who, int64_t *numbers, long room);
    void senders_rates(const Senders *, const uint64_t *who, int64_t *out);
    long senders_speakers(const Senders *, uint64_t *who, int64_t *numbers, long room);
    int senders_blocks(Senders *, const uint64_t *rows, long n);
    typedef struct { int64_t most_kinds, most_sources, most_sources_of_all, back_s; } VictimLimits;
    typedef struct Victims Victims;
    Victims *victims_new(const VictimLimits *, uint64_t seed);
    void victims_free(Victims *);
    int victims_add(Victims *, const Row *, long n, long trained);
    int64_t victims_rate(const Victims *, uint64_t kind, int32_t six, uint64_t hi, uint64_t lo);
    long victims_usual(const Victims *, uint64_t *out, long room);
    long victims_sources(const Victims *, uint64_t *out, long room);
    """
)

_DUMPS: Final = """
    long afterimage_dump(AfterImage *, uint8_t *out, long room);
    int afterimage_load(AfterImage *, const uint8_t *in, long size);
    long behaviour_dump(Behaviour *, uint8_t *out, long room);
    int behaviour_load(Behaviour *, const uint8_t *in, long size, int32_t switches);
    long senders_dump(Senders *, uint8_t *out, long room);
    int senders_load(Senders *, const uint8_t *in, long size, int32_t switches);
    long senders_kept(const Senders *, int32_t *out, long room);
    long victims_dump(Victims *, uint8_t *out, long room);
    int victims_load(Victims *, const uint8_t *in, long size);
    """

_DECLARATIONS: Final = (
    "typedef struct {"
    + "".join(f"const {c_type} *{name};" for name, c_type, _ in PACKET_FIELDS)
    + """} Columns;
    int32_t kitsune_kernel_version(void);
    typedef struct AfterImage AfterImage;
    AfterImage *afterimage_new(int bounded, int32_t max_streams, int32_t max_links, double horizon);
    void afterimage_free(AfterImage *);
    int afterimage_update(AfterImage *, const Columns *, const long *lengths, long n, double *out, long room);
    void afterimage_counts(const AfterImage *, uint64_t *out);
    typedef struct {
        int32_t count, visible, hidden;
        const int32_t *visible_of, *hidden_of, *input;
        double *weights, *hidden_bias, *visible_bias, *low, *high;
    } Layer;
    int kitnet_train(Layer *ensemble, Layer *output, const double *x, long n, long width,
                     double rate, double *scratch);
    const char *kitnet_vectors(void);
    int kitnet_moved(const Layer *ensemble, const Layer *output, const double *x, long width, const double *errors,
                     long first, const int32_t *rows, long n, int32_t *out);
    int kitnet_score(const Layer *ensemble, const Layer *output, const double *x, long n, long width,
                     double clip, double *scratch, double *errors, double *scores);
    """
)

_TYPES: Final = {kind: np.dtype(kind) for _, _, kind in ROW_FIELDS}
"""Reading the name of a type takes longer than comparing it."""


class ColumnError(ValueError):
    """A column of a batch is missing, has another length, or holds no numbers."""


class KernelMissing(RuntimeError):
    """The C kernel was not built, or belongs to another version."""


class Kernel(NamedTuple):
    """The loaded library and its cffi instance."""

    ffi: Any
    lib: Any

    def pointer(self, kind: str, array: npt.NDArray[Any]) -> Any:
        """The array's data for a parameter or field that points to `kind`; the array must be contiguous and
        outlive the call."""
        return self.ffi.from_buffer(array_type(kind), array)


@functools.cache
def array_type(kind: str) -> Any:
    """A type of C, which takes longer to read than a column to hand over."""
    return cffi.FFI().typeof(f"{kind}[]")


@functools.cache
def load_kernel(path: Path = _LIBRARY) -> Kernel:
    """The kernel.

    Raises:
        KernelMissing: it cannot be loaded.
    """
    ffi = cffi.FFI()
    ffi.cdef(_DECLARATIONS + _TRACKERS + _DUMPS)
    try:
        lib: Any = ffi.dlopen(str(path))
        if lib.kitsune_kernel_version() == VERSION:
            return Kernel(ffi, lib)
        problem = f"{path} belongs to another version"
    except (OSError, AttributeError) as error:
        problem = str(error)
    raise KernelMissing(
        f"Kitsune's kernel cannot be loaded: {problem}; install a C compiler (gcc) and reinstall SDNator with pip"
    )


def contiguous(array: npt.NDArray[Any], kind: str) -> npt.NDArray[Any]:
    """The array as the kernel reads it; copied only when type, layout or alignment differ.

    Raises `ColumnError` for what does not hold numbers.
    """
    if not isinstance(array, np.ndarray) or array.dtype.kind not in "iufb":
        raise ColumnError(f"a column holds {getattr(array, 'dtype', type(array).__name__)}, not numbers")
    flags = array.flags
    if (array.dtype is _TYPES.get(kind) or array.dtype == kind) and flags.c_contiguous and flags.aligned:
        return array
    return np.require(array, kind, ("C_CONTIGUOUS", "ALIGNED"))
