"""The C kernel under the address and undefined-behaviour sanitizers: whatever columns it gets, no report."""

import os
import subprocess
import sys

from apps.kitsune.kernel import SOURCES
from tests.requirements import require_program

FLAGS = [
    *("-shared", "-fPIC", "-g", "-O1", "-ffp-contract=off", "-fno-builtin-pow"),
    *("-fsanitize=address,undefined", "-fno-sanitize-recover=all"),
]


def test_random_and_extreme_columns_give_no_report(tmp_path):
    """Times backwards and NaN, numbers up to 2^64, columns of other lengths, layers that do not fit."""
    compiler = require_program("gcc")
    library = tmp_path / "kernel.so"
    subprocess.run([compiler, *FLAGS, "-o", library, *SOURCES, "-lm"], check=True)
    names = ("libasan.so", "libubsan.so")
    found = [
        subprocess.check_output([compiler, f"-print-file-name={name}"], text=True).strip() for name in names
    ]
    environment = {**os.environ, "LD_PRELOAD": " ".join(found), "ASAN_OPTIONS": "detect_leaks=0"}
    command = [sys.executable, "-m", "tests.apps.kitsune.sanitized", str(library), "1", "20"]
    done = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
    assert done.stdout == "clean\n", done.stderr[-4000:]
    assert done.returncode == 0
