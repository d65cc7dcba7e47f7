"""The enforcer `nftables` as a DUE app: blocks of the firewall in the kernel of this host."""

import sys
from collections.abc import Sequence

import due.service
from apps.enforcers.enforcer_app import ENFORCER_WANTS, EnforcerApp, enforcer_makes, place_name
from apps.enforcers.nftables.nft_program import NftProgram
from apps.enforcers.nftables.nft_table import NftTable
from apps.enforcers.nftables.ruleset import TablePlan
from apps.enforcers.nftables.settings import Settings
from due import Engine

INTERESTS = ENFORCER_WANTS
CAPABILITIES = enforcer_makes("nftables")


class NftablesService(EnforcerApp):
    """Keeps one table of this network namespace as the firewall decides; needs CAP_NET_ADMIN."""

    def __init__(self, engine: Engine, settings: Settings) -> None:
        plan = TablePlan(settings.table, settings.hooks, settings.priority)
        table = NftTable(plan, NftProgram(settings.program), settings.at_end)
        patience = {"check_s": settings.check_s, "patience_s": settings.patience_s}
        super().__init__(engine, "nftables", place_name(settings.place), table, **patience)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the enforcer until it is stopped."""
    return due.service.run("nftables", NftablesService, Settings, INTERESTS, CAPABILITIES, argv)


if __name__ == "__main__":
    sys.exit(main())
