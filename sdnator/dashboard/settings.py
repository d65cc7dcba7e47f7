"""Options of the dashboard, each with its default and its text."""

import msgspec


class DashboardOptions(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The page that `sdnator up` serves."""

    enabled: bool = True
    """Serve the page with `sdnator up`."""
    host: str = "127.0.0.1"
    """Address to listen on.  There is no TLS: put a proxy before it where others shall come."""
    port: int = 8470
    """Port; where it is taken, or 0: a free one, which `sdnator status` names."""
    names: tuple[str, ...] = ()
    """Host names under which browsers may ask for the page, besides localhost and addresses."""
    token_file: str = ""
    """File with the token that signs in; empty: `dashboard.token` in the state folder, made at the first
    start.  $SDNATOR_DASHBOARD_TOKEN goes before both."""
    frames: float = 4.0
    """Most updates of a page in a second."""
    history_s: float = 120.0
    """Seconds that the plot of scores shows."""

    def __post_init__(self) -> None:
        if not 0 <= self.port < 65_536:
            raise ValueError(f"port={self.port}: 0 to 65535")
        if not 0.1 <= self.frames <= 30:
            raise ValueError(f"frames={self.frames}: 0.1 to 30")
        if not 10 <= self.history_s <= 3_600:
            raise ValueError(f"history_s={self.history_s}: 10 to 3600")


class SwitchPlace(msgspec.Struct, frozen=True, kw_only=True):
    """Where a switch is read."""

    name: str
    address: str
    device_id: int = 1


class Settings(DashboardOptions, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options, and the places that the pipeline knows."""

    coordinator_file: str = ""
    """File that holds the URL of the Coordinator's HTTP API."""
    switches: tuple[SwitchPlace, ...] = ()
