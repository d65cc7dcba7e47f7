"""Which keeper looks after the rights on a server of Data Updates or Data Archives."""

from due.drivers.redis_wire import Wire
from due.errors import DueError, InvalidOption
from due.logs import without_passwords
from sdnator.errors import BadInput, PipelineError
from sdnator.rights.identities import Identities
from sdnator.rights.rights_keeper import RightsKeeper
from sdnator.rights.watching_keeper import WatchingKeeper

_KAFKA = ("kafka://", "kafkas://")
_MONGODB = ("mongodb://", "mongodb+srv://")
_CALL_SECONDS = 5.0


def keeper_of(updates: str, identities: Identities) -> WatchingKeeper:
    """The keeper of a Data Updates server."""
    if updates.startswith(_KAFKA):
        from sdnator.rights.kafka_keeper import KafkaRightsKeeper  # needs an extra

        return KafkaRightsKeeper(updates, identities)
    return RightsKeeper(updates, identities)


def try_updates(updates: str) -> None:
    """Whether a given Data Updates server is there.

    Raises:
        BadInput: the URL is malformed.
        PipelineError: nobody answers.
    """
    try:
        if updates.startswith(_KAFKA):
            _try_kafka(updates)
        else:
            Wire(updates).close()
    except InvalidOption as error:
        raise BadInput(f"--updates: {without_passwords(str(error))}") from None
    except DueError as error:
        raise PipelineError(without_passwords(str(error))) from None


def _try_kafka(updates: str) -> None:
    try:
        from confluent_kafka.admin import AdminClient

        from due.drivers.kafka_names import parse_kafka_url, translated
    except ImportError:
        raise InvalidOption("kafka:// needs Kafka's client: pip install 'sdnator[kafka]'") from None
    admin = AdminClient(parse_kafka_url(updates).client())
    translated(lambda: admin.list_topics(timeout=_CALL_SECONDS), without_passwords(updates))


def keeps_archives(archive: str) -> bool:
    """Whether a Data Archives server can have a user for each app."""
    return archive.startswith(_MONGODB)
