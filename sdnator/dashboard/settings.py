"""Options of the dashboard, each with its default and its text."""

import msgspec


class DashboardOptions(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The dashboard of `sdnator up`."""

    enabled: bool = True
    """Serve the dashboard with `sdnator up`."""
    host: str = "127.0.0.1"
    """Address to listen on.  There is no TLS: for access from other machines put a TLS proxy in front."""
    port: int = 8470
    """TCP port; if it is taken, or 0: a free one, which `sdnator status` shows."""
    names: tuple[str, ...] = ()
    """Host names that browsers may use for the dashboard, besides localhost and IP addresses."""
    token_file: str = ""
    """File with the owner's sign-in token; empty: `dashboard.token` in the state folder, made at the first start.
    $SDNATOR_DASHBOARD_TOKEN overrides both."""
    frames: float = 4.0
    """Maximum number of updates of the dashboard per second."""
    history_s: float = 120.0
    """Length of the score plot in seconds."""

    def __post_init__(self) -> None:
        if not 0 <= self.port < 65_536:
            raise ValueError(f"port={self.port}: must be 0 to 65535")
        if not 0.1 <= self.frames <= 30:
            raise ValueError(f"frames={self.frames}: must be 0.1 to 30")
        if not 10 <= self.history_s <= 3_600:
            raise ValueError(f"history_s={self.history_s}: must be 10 to 3600")


class SwitchPlace(msgspec.Struct, frozen=True, kw_only=True):
    """A switch that the dashboard reads."""

    name: str
    address: str
    device_id: int = 1
    security: dict[str, str | bool] = {}
    """How channels to it are secured: `ca`, `certificate` and `key`, files, or `insecure`; empty: by a Unix socket."""


class Settings(DashboardOptions, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options, and addresses that `sdnator up` fills in."""

    coordinator_file: str = ""
    """File that holds the URL of the Coordinator's HTTP API; if it names no token, $DUE_COORDINATOR_TOKEN is sent."""
    switches: tuple[SwitchPlace, ...] = ()
    state: str = ""
    """Folder with the users of the page and the link of `sdnator up`; empty: the owner's token alone signs in."""
    run_file: str = ""
    """File to which `sdnator up` writes the state of its parts; empty: none."""
