"""Loads the C kernel if it was built; otherwise the slower Python twins are used."""

import functools
import warnings
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

VERSION: Final = 2
"""Version of the C interface, compared with that of the library."""

_LIBRARY: Final = Path(__file__).with_name("_kernel.so")

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
    int kitnet_score(const Layer *ensemble, const Layer *output, const double *x, long n, long width,
                     double clip, double *scratch, double *errors, double *scores);
    """
)


class ColumnError(ValueError):
    """A column of a batch is missing, has another length, or holds no numbers."""


class Kernel(NamedTuple):
    """The loaded library and its cffi instance."""

    ffi: Any
    lib: Any

    def pointer(self, kind: str, array: npt.NDArray[Any]) -> Any:
        """A C pointer to the array's data; the array must be contiguous and outlive the call."""
        return self.ffi.cast(f"{kind} *", array.ctypes.data)


@functools.cache
def load_kernel(path: Path = _LIBRARY) -> Kernel | None:
    """The kernel, or None with one warning when it was not built (no C compiler at installation)."""
    ffi = cffi.FFI()
    ffi.cdef(_DECLARATIONS)
    try:
        lib: Any = ffi.dlopen(str(path))
        if lib.kitsune_kernel_version() == VERSION:
            return Kernel(ffi, lib)
        problem = f"{path} belongs to another version"
    except (OSError, AttributeError) as error:
        problem = str(error)
    warnings.warn(
        f"Kitsune runs on its Python twin, dozens of times slower: {problem}. "
        "Install a C compiler and reinstall SDNator (pip install) to get the kernel.",
        RuntimeWarning,
        stacklevel=3,
    )
    return None


def contiguous(array: npt.NDArray[Any], kind: str) -> npt.NDArray[Any]:
    """The array as the kernel reads it; copied only when type, layout or alignment differ.

    Raises `ColumnError` for what does not hold numbers.
    """
    if not isinstance(array, np.ndarray) or array.dtype.kind not in "iufb":
        raise ColumnError(f"a column holds {getattr(array, 'dtype', type(array).__name__)}, not numbers")
    return np.require(array, kind, ("C_CONTIGUOUS", "ALIGNED"))
