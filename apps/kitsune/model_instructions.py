"""What operators ask of the model.  Pure."""

from typing import Final, Literal

from apps.messages import Answer, Message, Name, sender_of
from due import Item

INSTRUCTIONS: Final = "network.instruction.operator.kitsune"
"""Only the command line's own key is heard: no other app may throw a model away."""
ANSWER: Final = "network.answer.kitsune.operator"


class ModelInstruction(Message, frozen=True, kw_only=True):
    """`network.instruction.operator.kitsune`."""

    id: Name
    verb: Literal["retrain", "renew"]
    """`retrain` throws the model away; `renew` trains another one beside it."""
    expires: int = 0
    """Wall time, ns since the epoch, after which it must not be carried out any more; 0 = never."""


def instruction_in(item: Item) -> ModelInstruction:
    """An instruction, written by the operator's app; raises `MessageError`."""
    sender_of(item)
    return ModelInstruction.from_value(item.value)


def late(instruction: ModelInstruction, wall_ns: int) -> Answer | None:
    """The answer to an instruction that is too old; None if it may be carried out."""
    if not 0 < instruction.expires < wall_ns:
        return None
    return Answer(
        id=instruction.id, done=False, text="the instruction came too late and was not carried out; ask again"
    )
