"""The enforcer `nftables` as a DUE app: blocks of the firewall in the kernel of this host."""

import sys
from collections.abc import Sequence
from typing import Any

import due.service
from apps.enforcers.enforcer_app import ENFORCER_WANTS, EnforcerApp, enforcer_makes, place_name
from apps.enforcers.nftables.nft_program import NftProgram
from apps.enforcers.nftables.nft_table import NftTable
from apps.enforcers.nftables.ruleset import TablePlan
from apps.enforcers.nftables.settings import Settings
from due import Engine

INTERESTS = ENFORCER_WANTS
CAPABILITIES = enforcer_makes("nftables")


class NftablesService:
    """Keeps one table of this network namespace as the firewall decides; needs CAP_NET_ADMIN."""

    def __init__(self, engine: Engine, settings: Settings) -> None:
        plan = TablePlan(settings.table, settings.hooks, settings.priority)
        table = NftTable(plan, NftProgram(settings.program), settings.at_end)
        patience = {"check_s": settings.check_s, "patience_s": settings.patience_s}
        self._app = EnforcerApp(engine, "nftables", place_name(settings.place), table, **patience)

    def start(self) -> None:
        """Restore what is in force, then subscribe."""
        self._app.start()

    def tick(self) -> None:
        """Look whether the worker works, and for what was lifted without us."""
        self._app.tick()

    def stop(self) -> None:
        """Carry out what waits; the table stays or goes, as the settings say."""
        self._app.stop()

    def health(self) -> dict[str, Any]:
        """Counters for the operator and for Prometheus."""
        return self._app.health()


def main(argv: Sequence[str] | None = None) -> int:
    """Run the enforcer until it is stopped."""
    return due.service.run("nftables", NftablesService, Settings, INTERESTS, CAPABILITIES, argv)


if __name__ == "__main__":
    sys.exit(main())
