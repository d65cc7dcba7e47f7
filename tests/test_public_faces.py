"""What other programs import from us is a list, and each entry says what goes in, what comes out and what is raised."""

import ast
import builtins
import dataclasses
import inspect
import json
import re
import subprocess
import sys
import textwrap
from importlib import import_module

import pytest

import due
import sdnator
import sdnator.testing

DUE = [
    "CONSUMER", "DB_ONLY", "NO_WAIT", "PRODUCER", "PUB_ONLY", "Assignment", "Capability", "DueError", "Engine",
    "Interest", "Item", "Key", "Observation", "Options", "RecordBatch", "Role",
]  # fmt: skip
SDNATOR = ["CaptureReplay", "Kitsune", "Query", "QueryResults", "replay_capture", "run_query"]
TESTING = [
    "AppRun", "Bystander", "Cable", "ControllerRun", "EntryBuilder", "Heard", "NothingWritten", "P4RuntimeClient",
    "SwitchDouble", "SwitchTarget", "TookTooLong", "wait_for",
]  # fmt: skip
FACES = {
    "due": DUE,
    "due.aio": ["items"],
    "due.service": ["Announcing", "Service", "read_struct", "run"],
    "sdnator": SDNATOR,
    "sdnator.testing": TESTING,
    "apps.kitsune.online": ["Kitsune"],
    "apps.sonata_adapter.query.language": None,
    "apps.sonata_adapter.query.expressions": None,
    "apps.sonata_adapter.query.text": None,
    "apps.enforcement": None,
    "apps.evidence": None,
    "apps.incidents": None,
    "apps.intake": None,
    "apps.messages": None,
    "apps.packets": None,
    "apps.standing_decisions": None,
    "apps.talkers": None,
}
"""Module to its public names; None = every public function and class that the module defines."""
HEAVY = ["numpy", "scipy", "grpc", "redis", "due", "apps", "msgspec", "sdnator.replay"]
LOADED = f"import json, sys, sdnator; print(json.dumps([name for name in {HEAVY} if name in sys.modules]))"
SECTION = re.compile(r"^(Args|Returns|Yields|Raises|Reference|Example):$", re.MULTILINE)


def _members(module_name):
    """(name, object) of the public functions and classes of a face."""
    module = import_module(module_name)
    names = FACES[module_name]
    if names is None:
        names = [name for name, value in vars(module).items() if _is_own(value, module_name, name)]
    return [(name, getattr(module, name)) for name in names]


def _is_own(value, module_name, name):
    own = inspect.isfunction(value) or inspect.isclass(value)
    return own and value.__module__ == module_name and not name.startswith("_")


def _functions():
    """(where, function or constructor, text that documents it) of every public function and method."""
    for module_name in FACES:
        for name, value in _members(module_name):
            where = f"{module_name}.{name}"
            if inspect.isfunction(value):
                yield where, value, inspect.cleandoc(value.__doc__ or "")
            elif inspect.isclass(value):
                yield from _methods(where, value)


def _methods(where, kind):
    for name, value in vars(kind).items():
        function = getattr(value, "__func__", value)
        written = not dataclasses.is_dataclass(kind) and not getattr(kind, "_is_protocol", False)
        if name == "__init__" and inspect.isfunction(function) and written:
            yield where, function, inspect.cleandoc(kind.__doc__ or "")
        elif inspect.isfunction(function) and not name.startswith("_"):
            yield f"{where}.{name}", function, inspect.cleandoc(function.__doc__ or "")


FUNCTIONS = {where: (function, text) for where, function, text in _functions()}


def _sections(text):
    """Title of each section of a docstring to its text; "" is what stands before the first."""
    parts = SECTION.split(text)
    return {"": parts[0]} | dict(zip(parts[1::2], parts[2::2], strict=True))


def _documented_arguments(text):
    entries = re.findall(r"^    ([\w*, ]+):", _sections(text).get("Args", ""), re.MULTILINE)
    return {name.strip(" *") for entry in entries for name in entry.split(",")}


def _raised(function):
    """Names of the classes that the body itself raises."""
    tree = ast.parse(textwrap.dedent(inspect.getsource(function)))
    calls = [node.exc for node in ast.walk(tree) if isinstance(node, ast.Raise) and node.exc is not None]
    names = [call.func if isinstance(call, ast.Call) else call for call in calls]
    return {name.id for name in names if isinstance(name, ast.Name) and name.id[0].isupper()}


def _with_bases(name, function):
    """An error and its base classes but the general ones: whichever of them is documented will do."""
    error = function.__globals__.get(name) or getattr(builtins, name)
    return {base.__name__ for base in error.__mro__} - {"Exception", "BaseException", "object"}


@pytest.mark.parametrize(
    ("module", "names"),
    [(due, DUE), (sdnator, SDNATOR), (sdnator.testing, TESTING)],
    ids=["due", "sdnator", "sdnator.testing"],
)
def test_nothing_becomes_public_by_accident(module, names):
    """A package exports what is listed here, in this order, and every name leads to something."""
    assert module.__all__ == names
    assert set(names) <= set(dir(module))
    assert all(getattr(module, name) is not None for name in names)


def test_another_name_is_refused_with_the_list():
    """A misspelt name is an AttributeError that says what there is."""
    with pytest.raises(AttributeError, match="replay_capture"):
        _ = sdnator.replay_captures


def test_the_import_alone_loads_nothing_heavy():
    """`import sdnator` stands at the start of every command, so it must not wait for numpy or gRPC."""
    done = subprocess.run([sys.executable, "-c", LOADED], capture_output=True, text=True, check=True)
    assert json.loads(done.stdout) == []


def test_every_face_has_entries():
    """The rules below look at something in each module."""
    assert all(any(where.startswith(f"{module}.") for where in FUNCTIONS) for module in FACES)


@pytest.mark.parametrize("module", FACES)
def test_every_class_says_what_it_is(module):
    """Each public class has a docstring of its own."""
    classes = [(name, value) for name, value in _members(module) if inspect.isclass(value)]
    assert [name for name, value in classes if not vars(value).get("__doc__")] == []


@pytest.mark.parametrize("where", FUNCTIONS)
def test_every_argument_is_documented(where):
    """Args names each parameter, and no other; a class documents those of its constructor."""
    function, text = FUNCTIONS[where]
    parameters = set(inspect.signature(function).parameters) - {"self", "cls"}
    assert text, "it has a docstring"
    assert _documented_arguments(text) == parameters


@pytest.mark.parametrize("where", FUNCTIONS)
def test_every_result_is_documented(where):
    """What returns a value has a section Returns, a generator one called Yields."""
    function, text = FUNCTIONS[where]
    returned = inspect.signature(function).return_annotation
    gives = returned not in (None, "None", inspect.Signature.empty)
    assert bool({"Returns", "Yields"} & set(_sections(text))) == gives


@pytest.mark.parametrize("where", FUNCTIONS)
def test_every_error_is_documented(where):
    """What a body raises stands in Raises, by its name or that of a base class; nowhere else is it hidden."""
    function, text = FUNCTIONS[where]
    section = _sections(text).get("Raises", "")
    documented = set(re.findall(r"\b[A-Z]\w+", section))
    assert {name for name in _raised(function) if not _with_bases(name, function) & documented} == set()
    assert "raises `" not in _sections(text)[""].lower(), "errors belong into the section Raises"
