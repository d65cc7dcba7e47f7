"""Builds the optional C kernel; everything else is declared in pyproject.toml.

The kernel is a plain shared object loaded with cffi (ABI mode): it includes no Python header, so a
compiler is all it needs.  Without one the installation still succeeds and the Python twin is used.
"""

from pathlib import Path

from setuptools import Extension, setup
from setuptools.command.build_ext import build_ext


class BuildKernel(build_ext):
    """Names the library as the loader looks for it, whatever the Python version."""

    def get_ext_filename(self, fullname: str) -> str:
        return str(Path(*fullname.split(".")).with_suffix(".so"))


setup(
    ext_modules=[
        Extension(
            "apps.kitsune._kernel",
            sources=["apps/kitsune/afterimage.c", "apps/kitsune/kitnet.c"],
            depends=[f"apps/kitsune/afterimage_{part}.h" for part in ("keys", "pool", "state")],
            # equality with the published features depends on these: see afterimage.c
            extra_compile_args=["-O2", "-ffp-contract=off", "-fno-builtin-pow"],
            libraries=["m"],
            py_limited_api=True,
            optional=True,
        )
    ],
    cmdclass={"build_ext": BuildKernel},
    options={"bdist_wheel": {"py_limited_api": "cp311"}},
)
