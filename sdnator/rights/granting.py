"""What an app is granted: interests and capabilities are requests, `[[grants]]` decides.  Pure.

the product's parts ──────► what stands in the table below
declared by other apps ───► granted, without the dangerous keys; of the archive, what they wrote themselves
[[grants]] ───────────────► that as well, the dangerous keys included
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from due.drivers.redis_rights import EVERYTHING, Rights, covers
from due.keys import Key
from sdnator import app_catalogue
from sdnator.app_catalogue import ENFORCERS
from sdnator.config.up_settings import GrantPlan

DANGEROUS = (
    *("block", "block_prefix", "protect", "meter", "p4_command", "packet_out", "telemetry", "cell_request"),
    *("instruction", "allowed", "clock"),
)
"""Families of keys that command a switch, an enforcer or an app: only for apps that are granted them by name."""
OPERATOR = "operator"
"""Identity of the user who started the pipeline: any key, as any app."""
_OWN = "network.*.{}.**"
_DECISIONS = tuple(f"network.{family}.firewall.*" for family in ("block", "block_prefix", "protect", "meter"))
_SWITCHES = "network.switch.p4runtime_ctrl.*"
_PRODUCT: dict[str, Rights] = {
    one.app: one
    for one in (
        Rights(
            app="coordinator",
            publish=("due.assignment.*", "due.leader.coordinator", "due.event.coordinator"),
            # its HTTP API shows any key
            observe=(EVERYTHING,),
            read=(EVERYTHING,),
        ),
        Rights(
            app="p4runtime_ctrl",
            publish=(_OWN.format("p4runtime_ctrl"),),
            observe=(
                *_DECISIONS,
                *(f"network.{family}.*.*" for family in ("p4_command", "telemetry", "cell_request")),
                *(f"network.{family}.*.*" for family in ("packet_out", "clock")),
                _SWITCHES,  # of its other instances
            ),
            read=(*_DECISIONS, "network.p4_command.*.*", "network.telemetry.*.*"),
        ),
        Rights(
            app="kitsune",
            publish=(_OWN.format("kitsune"),),
            observe=(
                *("network.packets.p4runtime_ctrl.*.all", "network.block.firewall.*", _SWITCHES),
                "network.instruction.*.kitsune",
            ),
        ),
        Rights(
            app="sonata_adapter",
            publish=(_OWN.format("sonata_adapter"), _OWN.format("sonata")),
            observe=(
                *(_SWITCHES, "network.training.*", "network.cell.p4runtime_ctrl.*"),
                *(
                    f"network.{family}.p4runtime_ctrl.*.*"
                    for family in ("packets", "frames", "digests", "counts")
                ),
            ),
            read=(_SWITCHES, "network.training.*"),
        ),
        Rights(
            app="firewall",
            publish=(_OWN.format("firewall"), "network.p4_command.firewall_kept.*"),
            observe=(
                *("network.anomaly.kitsune.alert", "network.evidence.*.*", "network.training.*", _SWITCHES),
                *("network.confirmation.*.*", "network.enforced.*.*", "network.instruction.*.firewall"),
                "network.packets.p4runtime_ctrl.*.*",
                *(
                    f"network.{family}.sonata.*"
                    for family in ("handshake", "traffic_query", "traffic_capture")
                ),
            ),
            read=("network.handshake.sonata.tcp", "network.instruction.*.firewall"),
        ),
        Rights(
            app="dashboard",
            publish=("network.instruction.dashboard.*", "network.audit.dashboard.*"),
            observe=(
                *("network.anomaly.kitsune.score", "network.anomaly.kitsune.alert", *_DECISIONS, _SWITCHES),
                *("network.confirmation.*.*", "network.incident.firewall.*", "network.answer.*.dashboard"),
                *("network.query_plan.sonata_adapter", "network.traffic.kitsune.*", "due.health.*"),
            ),
            read=(EVERYTHING,),  # its page shows the archive
        ),
        *(
            Rights(
                app=name,
                publish=(_OWN.format(name),),
                observe=(*_DECISIONS, "network.allowed.firewall"),
                read=(*_DECISIONS, "network.allowed.firewall"),
            )
            for name in ENFORCERS
        ),
    )
}
"""Rights of the product's parts: a test compares them with what the parts declare. Written out here, because the
program that starts the parts must not import them."""


@dataclass(frozen=True)
class Granted:
    """The rights of an app, and the declared keys that it was not granted."""

    rights: Rights
    withheld: tuple[str, ...] = ()


def operator() -> Rights:
    """The rights of the user who started the pipeline."""
    return Rights(app="*", publish=(EVERYTHING,), observe=(EVERYTHING,), read=(EVERYTHING,))


def granted(name: str, plans: Sequence[GrantPlan] = ()) -> Granted:
    """The rights of a part of the pipeline.

    Args:
        name: the Coordinator, the dashboard or an installed app.
        plans: `[[grants]]`.

    Raises:
        BadInput: there is no such app, or its module cannot be loaded.
    """
    if name in _PRODUCT:
        return Granted(_with(_PRODUCT[name], plans))
    app = app_catalogue.of(name)
    publish = tuple(Key.parse(one.key).path for one in app.capabilities)
    observe = tuple(Key.parse(one.key).path for one in app.interests)
    return declared(name, publish, observe, plans)


def _with(rights: Rights, plans: Sequence[GrantPlan]) -> Rights:
    own = [plan for plan in plans if plan.app == rights.app]
    publish = (*rights.publish, *(key for plan in own for key in plan.publish))
    observe = (*rights.observe, *(key for plan in own for key in plan.observe))
    read = (*rights.read, *(key for plan in own for key in plan.read))
    return Rights(app=rights.app, publish=_unique(publish), observe=_unique(observe), read=_unique(read))


def declared(
    name: str, publish: Sequence[str], observe: Sequence[str], plans: Sequence[GrantPlan] = ()
) -> Granted:
    """The rights of an app that is not the product's.

    Args:
        name: its id.
        publish: paths of its capabilities.
        observe: paths of its interests.
        plans: `[[grants]]`.
    """
    if not all(plan.declared for plan in plans if plan.app == name):
        publish, observe = (), ()
    harmless = tuple(key for key in publish if not is_dangerous(key, name))
    rights = _with(Rights(app=name, publish=harmless, observe=tuple(observe)), plans)
    withheld = tuple(key for key in publish if not any(covers(one, key) for one in rights.publish))
    return Granted(rights, withheld)


def is_dangerous(pattern: str, app: str) -> bool:
    """Whether items of this pattern command something, or may be taken for those of an app of the product."""
    path = Key.parse(Key.parse(pattern).path)
    if path.segments[0] not in ("network", "*", "**"):
        return path.segments[0] == "due"
    others = (f"network.*.{one}.**" for one in _PRODUCT if one != app)
    families = (f"network.{family}.**" for family in DANGEROUS)
    return any(Key.parse(one).offers(path) for one in (*families, *others, "due.**"))


def _unique(patterns: Iterable[str]) -> tuple[str, ...]:
    return tuple(dict.fromkeys(patterns))
