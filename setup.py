"""Builds what pyproject.toml cannot declare: the C libraries and the switch program's place.

They are plain shared objects loaded with cffi (ABI mode): they include no Python header, so a
compiler is all they need.  Without one Kitsune's cannot be built, and the installation ends with the compiler's error;
digests would be read by protobuf.

The switch program lives in `p4/`, which is no package (a package of that name would hide `p4.v1` of the
P4Runtime wheel).  In a wheel its sources, artefacts and record are data of `sdnator`, in
`sdnator/program/`; a checkout and an editable installation read `p4/` itself.
"""

import shutil
import warnings
from pathlib import Path

from setuptools import Extension, setup
from setuptools.command.build_ext import build_ext
from setuptools.command.build_py import build_py

PROGRAM = Path("p4")
KINDS = (".p4", ".json", ".txtpb")

# pip shows setuptools' general remark on editable installations as if something of ours were wrong
warnings.filterwarnings("ignore", message="Editable installation")


class BuildKernel(build_ext):
    """Names a library as the loader looks for it, whatever the Python version."""

    def get_ext_filename(self, fullname: str) -> str:
        return str(Path(*fullname.split(".")).with_suffix(".so"))


class BuildWithProgram(build_py):
    """Adds the switch program, where `sdnator.p4_program` looks for it."""

    def run(self) -> None:
        super().run()
        if not self.editable_mode:
            for source, target in self._program():
                target.parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(source, target)

    def get_outputs(self, include_bytecode: bool = True) -> list[str]:
        """Also the program's files: what is named here is what an installation holds."""
        own = [] if self.editable_mode else [str(target) for _, target in self._program()]
        return [*super().get_outputs(include_bytecode), *own]

    def _program(self) -> list[tuple[Path, Path]]:
        base = Path(self.build_lib) / "sdnator" / "program"
        files = sorted(path for path in PROGRAM.rglob("*") if path.suffix in KINDS)
        return [(path, base / path.relative_to(PROGRAM)) for path in files]


setup(
    ext_modules=[
        Extension(
            "apps.kitsune._kernel",
            sources=[
                f"apps/kitsune/{part}.c"
                for part in ("afterimage", "kitnet", "behaviour", "senders", "victims")
            ],
            depends=[
                *(
                    f"apps/kitsune/afterimage_{part}.h"
                    for part in ("keys", "pool", "state", "damping", "hubs", "dump")
                ),
                *(
                    f"apps/kitsune/{part}_dump.h"
                    for part in ("state", "table", "senders", "victims", "behaviour")
                ),
                *(
                    f"apps/kitsune/{part}.h"
                    for part in (
                        *("hash_table", "packet_rows"),
                        *(
                            f"behaviour_{each}"
                            for each in ("counter", "state", "findings", "prefetch", "setup")
                        ),
                    )
                ),
            ],
            # the first unrolls the loops over five time scales: features and scores take 7 % less than with -O2;
            # equality with the published features depends on the second and third: see afterimage.c; without the last
            # comparisons become branches, and the sigmoids of kitnet.c are not computed in vectors
            extra_compile_args=["-O3", "-ffp-contract=off", "-fno-builtin-pow", "-fno-trapping-math"],
            libraries=["m"],
            py_limited_api=True,
        ),
        Extension(
            "apps.p4runtime_ctrl.southbound._digest_rows",
            sources=["apps/p4runtime_ctrl/southbound/digest_rows.c"],
            extra_compile_args=["-O2"],
            py_limited_api=True,
            optional=True,
        ),
    ],
    cmdclass={"build_ext": BuildKernel, "build_py": BuildWithProgram},
    options={"bdist_wheel": {"py_limited_api": "cp311"}},
)
