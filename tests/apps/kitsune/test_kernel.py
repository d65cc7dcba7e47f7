"""A kernel that cannot be used is an error that says why, and what to do."""

import subprocess

import numpy as np
import pytest

from apps.kitsune.kernel import KernelMissing, contiguous, load_kernel
from tests.requirements import require_program


def test_a_missing_library_names_the_remedy(tmp_path):
    with pytest.raises(KernelMissing, match=r"install a C compiler .* and reinstall"):
        load_kernel(tmp_path / "_kernel.so")


def test_a_damaged_library_is_not_used(tmp_path):
    (tmp_path / "_kernel.so").write_bytes(b"not a library")
    with pytest.raises(KernelMissing):
        load_kernel(tmp_path / "_kernel.so")


@pytest.mark.parametrize("source", ["int kitsune_kernel_version(void) { return 0; }", "int other;"])
def test_a_library_of_another_version_is_not_used(tmp_path, source):
    (tmp_path / "old.c").write_text(source)
    library = tmp_path / "_kernel.so"
    subprocess.run(
        [require_program("gcc"), "-shared", "-fPIC", "-o", library, tmp_path / "old.c"], check=True
    )
    with pytest.raises(KernelMissing):
        load_kernel(library)


@pytest.mark.parametrize("shift", [0, 1, 4])
def test_the_kernel_gets_aligned_numbers_wherever_they_stood(shift):
    """Columns of a frame may begin anywhere in its bytes; C may read numbers at multiples of their size only."""
    data = np.arange(5, dtype="u8").tobytes()
    column = np.frombuffer(bytes(shift) + data, "u8", 5, shift)
    given = contiguous(column, "u8")
    assert given.flags.aligned
    assert given.flags.c_contiguous
    assert given.tolist() == [0, 1, 2, 3, 4]
