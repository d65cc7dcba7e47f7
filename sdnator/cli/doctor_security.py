"""`sdnator doctor --security`: who could read, say or reach more than meant, running or not."""

import ipaddress
import stat
from collections.abc import Iterator
from pathlib import Path
from urllib.error import HTTPError, URLError
from urllib.parse import unquote, urlsplit

from sdnator.cli.doctor import Check
from sdnator.config import config_file
from sdnator.config.up_settings import SwitchPlan
from sdnator.errors import BadInput
from sdnator.northbound import without_user
from sdnator.plurals import counted
from sdnator.redaction import redacted
from sdnator.rights.granting import OPERATOR, is_dangerous
from sdnator.rights.identities import Identities
from sdnator.rights.users import Users
from sdnator.up import running

_SECRETS = (
    "identities.json",
    "readers.json",
    "users.json",
    "dashboard.link",
    "certificates/*.key",
    "run.json",
    "*.engine.json",
    "*.settings.json",
    "*.token",
    "coordinator.url",
)
_SECONDS = 5.0
_NOT_READ = "repair the file's owner and mode"
_UNIX = "unix:"
_ELSEWHERE = ("redis://", "redis+sentinel://", "mongodb://", "kafka://")


def security_checks() -> Iterator[Check]:
    """All of them.  Raises BadInput for a wrong configuration."""
    state, config = running.state_folder(), config_file.load(config_file.find())
    found = running.find()
    archive = found.archive if found is not None else config.struct("up").archive or running.default_archive()
    yield check_folder_mode(state)
    yield check_secrets(state)
    yield check_archive_mode(archive, found)
    yield check_listeners(config)
    yield check_switches(config, found)
    yield check_page_users(state, config)
    yield check_urls(config, found)
    yield check_commanding(state)
    yield check_readers(state)
    if found is not None:
        yield check_server_rights(found)
        yield check_coordinator_token(found)


def check_folder_mode(folder: Path) -> Check:
    """Whether others may look into the state folder."""
    if not folder.exists():
        return Check("state folder", "ok", f"{folder} does not exist yet")
    if others := _others(folder):
        return Check("state folder", "exposed", f"{folder} has mode {others}", f"chmod 700 {folder}")
    return Check("state folder", "ok", f"only its owner can read {folder}")


def check_secrets(folder: Path) -> Check:
    """Whether others may read a file with a credential."""
    files = sorted({path for pattern in _SECRETS for path in folder.glob(pattern)})
    wide = [str(path) for path in files if _others(path)]
    if wide:
        said = f"others can read {', '.join(wide)}"
        return Check(
            "secrets", "exposed", said, f"chmod 600 {' '.join(wide)}, and create new ones: docs/security.md"
        )
    return Check("secrets", "ok", f"{len(files)} files with credentials, each readable by its owner alone")


def check_archive_mode(url: str, found: running.Running | None = None) -> Check:
    """Whether others may read the archive."""
    if url.startswith("mongodb"):
        if found is None or "app=" in urlsplit(url).query:
            return Check("archive", "ok", f"{redacted(url)}: each app has its own collections and role")
        said = f"{redacted(url)}: every app may read and write all of it"
        return Check(
            "archive", "exposed", said, "run mongod --auth, and give --archive a user that may create users"
        )
    if not url.startswith("sqlite:"):
        return Check("archive", "ok", f"{redacted(url)}: held by the process itself")
    path = Path(unquote(urlsplit(url).path))
    if path.exists() and _others(path):
        return Check("archive", "exposed", f"others can read {path}", f"chmod 600 {path}")
    return Check("archive", "ok", f"only its owner can read {path}")


def check_listeners(config: config_file.Config) -> Check:
    """What is configured to listen for other machines."""
    places = {
        "dashboard.host": config.struct("dashboard").host,
        "coordinator.http_host": config.struct("coordinator").http_host,
        "metrics.host": config.struct("metrics").host,
    }
    wide = [f"{name}={place}" for name, place in places.items() if not _is_local(place)]
    if wide:
        remedy = "keep it on loopback, or put a proxy with TLS and a login in front of it"
        return Check("listeners", "exposed", f"other machines reach {', '.join(wide)} without TLS", remedy)
    return Check("listeners", "ok", "everything listens on loopback or on sockets of the state folder")


def check_switches(config: config_file.Config, found: running.Running | None) -> Check:
    """Switches that speak P4Runtime over TCP without certificates, by the configuration and in the pipeline."""
    named = {one.name for one in config.switches() if one.insecure and not _by_socket(one)}
    running_now = () if found is None else (found.switches or (found.switch,))
    named |= {
        str(one["name"])
        for one in running_now
        if one.get("security", {}).get("insecure") and not str(one["address"]).startswith(_UNIX)
    }
    if named:
        said = f"anyone who reaches the P4Runtime port of {', '.join(sorted(named))} controls the switch"
        return Check("switches", "exposed", said, "`sdnator cert init`, and leave out insecure = true")
    return Check("switches", "ok", "P4Runtime by Unix socket, or with certificates on both sides")


def check_page_users(state: Path, config: config_file.Config) -> Check:
    """Whether people sign in to the dashboard by name, or all of them share the owner's token."""
    options = config.struct("dashboard")
    if not options.enabled:
        return Check("page", "ok", "it is not served")
    try:
        users = Users(state).all
    except BadInput as error:
        return Check("page", "exposed", str(error), "nobody but the owner can sign in")
    if users:
        operators = sorted(name for name, one in users.items() if one.role == "operator")
        said = f"{counted(len(users), 'user')}; operators: {', '.join(operators) or 'none'}"
        return Check("page", "ok", said)
    if _is_local(options.host):
        return Check("page", "ok", "there are no users: the owner's token or link signs in, and nothing else")
    said = (
        f"there are no users, and dashboard.host={options.host}: everybody who looks shares the owner's token"
    )
    return Check("page", "exposed", said, "`sdnator user add NAME` for each of them")


def check_urls(config: config_file.Config, found: running.Running | None) -> Check:
    """Backends on other machines without TLS."""
    up = config.struct("up")
    urls = {up.updates, up.archive} | ({found.updates, found.archive} if found is not None else set())
    bare = sorted(
        redacted(url)
        for url in urls
        if url.startswith(_ELSEWHERE) and not all(map(_is_local, _hosts(url))) and "tls=true" not in url
    )
    if bare:
        return Check(
            "backends",
            "exposed",
            f"{', '.join(bare)}: without TLS",
            "use rediss://, rediss+sentinel://, kafkas:// or mongodb://…?tls=true",
        )
    return Check("backends", "ok", "no password crosses the network without TLS")


def _hosts(url: str) -> list[str]:
    """Of a URL, which may name several."""
    places = url.partition("://")[2].partition("/")[0].rpartition("@")[2].split(",")
    return [urlsplit(f"//{place}").hostname or "" for place in places]


def check_commanding(state: Path) -> Check:
    """Who outside the pipeline may command."""
    try:
        identities = Identities(state).all
    except BadInput as error:
        return Check("commanding apps", "exposed", str(error), _NOT_READ)
    named = sorted(
        f"{name} ({key})"
        for name, one in identities.items()
        if one.enrolled and name != OPERATOR
        for key in one.rights.publish
        if is_dangerous(key, name)
    )
    if named:
        return Check("commanding apps", "ok", ", ".join(named), "")
    return Check("commanding apps", "ok", "no enrolled app may command a switch, an enforcer or an app")


def check_readers(state: Path) -> Check:
    """Which apps outside the pipeline may read from the archive what others wrote."""
    try:
        identities = Identities(state).all
    except BadInput as error:
        return Check("reading apps", "exposed", str(error), _NOT_READ)
    named = sorted(
        f"{name} ({', '.join(one.rights.read)})"
        for name, one in identities.items()
        if one.enrolled and one.rights.read
    )
    said = ", ".join(named) or "no enrolled app may read from the archive what others wrote"
    return Check("reading apps", "ok", said)


def check_server_rights(found: running.Running) -> Check:
    """Whether Data Updates refuses connections without a credential."""
    from due.drivers.redis_wire import Wire
    from due.errors import DueError

    scheme, _, rest = found.updates.partition("://")
    bare = f"{scheme}://{rest.rpartition('@')[2]}"
    if scheme.startswith("kafka"):
        return _check_brokers(bare)
    try:
        wire = Wire(bare)
        answer = wire.call("PUBLISH", "due:sdnator.doctor", "")
        wire.close()
    except DueError:
        return Check("Data Updates", "ok", "nobody connects without a credential")
    if isinstance(answer, Exception):
        return Check("Data Updates", "ok", "nothing can be published without a credential")
    remedy = "give the server a password, and --updates a user that may create users (ACL)"
    return Check("Data Updates", "exposed", f"{redacted(bare)} lets anybody publish", remedy)


def _check_brokers(bare: str) -> Check:
    from sdnator.errors import PipelineError
    from sdnator.rights.keeping import try_updates

    try:
        try_updates(bare)
    except PipelineError:
        return Check("Data Updates", "ok", "nobody connects without a credential")
    remedy = "use brokers with SASL and an authorizer, and give --updates a super user: docs/security.md"
    return Check("Data Updates", "exposed", f"{redacted(bare)} lets anybody publish", remedy)


def check_coordinator_token(found: running.Running) -> Check:
    """Whether the Coordinator's API refuses requests without a token."""
    from urllib.request import ProxyHandler, build_opener

    url = without_user(found.coordinator)
    try:
        with build_opener(ProxyHandler({})).open(f"{url}/apps", timeout=_SECONDS):
            pass
    except HTTPError as error:
        return Check("Coordinator", "ok", f"{url} answers {error.code} without a token")
    except (URLError, OSError) as error:
        return Check("Coordinator", "ok", f"{url} does not answer: {error}")
    return Check("Coordinator", "exposed", f"{url} shows everything to anybody", "restart the pipeline")


def _others(path: Path) -> str:
    """The mode where others than the owner may do something; empty where they may not."""
    mode = stat.S_IMODE(path.stat().st_mode)
    return f"{mode:o}" if mode & 0o077 else ""


def _by_socket(switch: SwitchPlan) -> bool:
    """An embedded switch without an address listens on a socket."""
    place = switch.listen if switch.kind in ("embedded", "bmv2") else switch.kind
    return place.startswith(_UNIX) or (switch.kind == "embedded" and not place)


def _is_local(host: str) -> bool:
    if host in ("", "localhost"):
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False
