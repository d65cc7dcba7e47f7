"""Every public name below `sdnator.testing` is documented; its face is in `tests/test_public_faces.py`."""

import importlib
import inspect
import pkgutil

import pytest

from sdnator import testing

MODULES = sorted(
    module.name for module in pkgutil.walk_packages(testing.__path__, prefix=f"{testing.__name__}.")
)


def public(module):
    """(name, object) of functions and classes that a module defines, and of their methods."""
    for name, thing in vars(module).items():
        if name.startswith("_") or getattr(thing, "__module__", None) != module.__name__:
            continue
        if inspect.isfunction(thing) or inspect.isclass(thing):
            yield name, thing
        if inspect.isclass(thing):
            for method, function in vars(thing).items():
                if inspect.isfunction(function) and not method.startswith("_"):
                    yield f"{name}.{method}", function


@pytest.mark.parametrize("name", MODULES)
def test_every_public_name_is_documented(name):
    """Module, functions, classes and methods say what they promise."""
    module = importlib.import_module(name)
    assert module.__doc__
    assert not [what for what, thing in public(module) if not thing.__doc__]
