"""Without the kernel the twin takes over, with one warning that says why."""

import shutil
import subprocess
import warnings

import numpy as np
import pytest

from apps.kitsune.kernel import contiguous, load_kernel
from tests.requirements import require_program


def test_a_missing_library_warns_once_and_names_the_remedy(tmp_path):
    with pytest.warns(RuntimeWarning, match="Install a C compiler and reinstall"):
        assert load_kernel(tmp_path / "_kernel.so") is None
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert load_kernel(tmp_path / "_kernel.so") is None


def test_a_damaged_library_is_not_used(tmp_path):
    (tmp_path / "_kernel.so").write_bytes(b"not a library")
    with pytest.warns(RuntimeWarning):
        assert load_kernel(tmp_path / "_kernel.so") is None


@pytest.mark.parametrize("source", ["int kitsune_kernel_version(void) { return 0; }", "int other;"])
def test_a_library_of_another_version_is_not_used(tmp_path, source):
    compiler = shutil.which("cc") or require_program("gcc")
    (tmp_path / "old.c").write_text(source)
    library = tmp_path / "_kernel.so"
    subprocess.run([compiler, "-shared", "-fPIC", "-o", library, tmp_path / "old.c"], check=True)
    with pytest.warns(RuntimeWarning):
        assert load_kernel(library) is None


@pytest.mark.parametrize("shift", [0, 1, 4])
def test_the_kernel_gets_aligned_numbers_wherever_they_stood(shift):
    """Columns of a frame may begin anywhere in its bytes; C may read numbers at multiples of their size only."""
    data = np.arange(5, dtype="u8").tobytes()
    column = np.frombuffer(bytes(shift) + data, "u8", 5, shift)
    given = contiguous(column, "u8")
    assert given.flags.aligned
    assert given.flags.c_contiguous
    assert given.tolist() == [0, 1, 2, 3, 4]
