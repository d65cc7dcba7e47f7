"""Message classes of P4Runtime, made from the descriptors that the p4runtime wheel carries.

`p4runtime.PacketIn` and the like are attributes of the namespaces below; enum values stand beside
them (`p4runtime.Update.INSERT`, `p4runtime.SUBSCRIPTION_..`), as protoc's own modules have it.
"""

import ast
import importlib.metadata
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from google.protobuf import any_pb2, descriptor_pool, message_factory
from google.rpc import status_pb2

_WHEEL = "p4runtime"
# In the order of their imports: a file must be registered before those that import it.
_FILES = ("p4/config/v1/p4types", "p4/config/v1/p4info", "p4/v1/p4data", "p4/v1/p4runtime")


def _serialized_descriptor(path: str) -> bytes:
    """The `serialized_pb` literal of a generated module, found in its syntax tree."""
    source = Path(str(importlib.metadata.distribution(_WHEEL).locate_file(f"{path}_pb2.py")))
    for node in ast.walk(ast.parse(source.read_text(encoding="utf-8"))):
        if (
            isinstance(node, ast.keyword)
            and node.arg == "serialized_pb"
            and isinstance(node.value, ast.Constant)
            and isinstance(node.value.value, bytes)
        ):
            return node.value.value
        # protoc >= 3.20 writes AddSerializedFile(b'...') instead
        if isinstance(node, ast.Call) and getattr(node.func, "attr", "") == "AddSerializedFile":
            return bytes(ast.literal_eval(node.args[0]))
    raise ImportError(f"no file descriptor in {source}: the {_WHEEL} package has an unknown layout")


def _namespace(path: str) -> Any:
    pool = descriptor_pool.Default()
    name = f"{path}.proto"
    try:
        described = pool.FindFileByName(name)
    except KeyError:
        pool.AddSerializedFile(_serialized_descriptor(path))
        described = pool.FindFileByName(name)
    members: dict[str, Any] = {
        message.name: message_factory.GetMessageClass(message)
        for message in described.message_types_by_name.values()
    }
    for enum in described.enum_types_by_name.values():
        members |= {value.name: value.number for value in enum.values}
    return SimpleNamespace(DESCRIPTOR=described, **members)


assert any_pb2.DESCRIPTOR  # noqa: S101 - imported for its side effect: p4info.proto imports any.proto
status: Any = status_pb2
p4types, p4info, p4data, p4runtime = (_namespace(path) for path in _FILES)
