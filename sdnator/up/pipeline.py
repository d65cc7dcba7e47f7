"""The pipeline that `sdnator up` keeps running: a supervisor with the parts of its plan."""

from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import asdict
from functools import partial
from typing import Any

from sdnator.redaction import redacted
from sdnator.rights.granting import OPERATOR
from sdnator.rights.keeping import keeper_of, keeps_archives, try_updates
from sdnator.rights.watching_keeper import RightsRefused
from sdnator.supervisor import LogLimits, PartReport, Supervisor
from sdnator.supervisor.log_rotation import put_aside
from sdnator.supervisor.whole_or_none import WholeOrNone
from sdnator.up.parts import UpParts
from sdnator.up.plan import StandingPlan, changes, taken_up


class StandingPipeline(WholeOrNone):
    """A running pipeline; a context manager.  `tell` gets a line for each part that is restarted.

    Raises:
        BadInput: for a malformed Data Updates URL.
        PipelineError: from entering, naming the part that did not start, with the end of its log.
    """

    def __init__(self, plan: StandingPlan, tell: Callable[[str], None]) -> None:
        self._tell = tell
        self._stack = ExitStack()
        self._parts = UpParts(plan, self._stack)
        chosen = plan.supervisor
        self._limits = LogLimits(
            file_bytes=chosen.file_bytes, files=chosen.log_files, minute_bytes=chosen.minute_bytes
        )
        self._supervisor = Supervisor(self._parts.specs(), tell, self._limits)
        self._keeper = keeper_of(self._parts.server, self._parts.identities)

    def _start(self) -> None:
        logs = self._parts.logs
        logs.mkdir(mode=0o700, parents=True, exist_ok=True)
        for log in logs.glob("*.log"):
            put_aside(log, self._limits.files)
        self._parts.address_file.unlink(missing_ok=True)
        if self.plan.updates:
            try_updates(self.plan.updates)
            self._make_users()
        self._make_archive_users()
        for name, one in self._parts.granted.items():
            if one.withheld:
                keys = ", ".join(one.withheld)
                self._tell(f"{name} may not publish {keys}: add [[grants]] for it if it should")
        self._supervisor.start()
        if self._parts.enforced:
            self._keeper.start()
            self._stack.callback(self._keeper.stop)

    def _make_users(self) -> None:
        """On a given server: a user for each app; all share the given credential where it may make none."""
        try:
            self._keeper.apply()
        except RightsRefused as error:
            self._parts.share_credential()
            self._tell(
                f"every app may do everything on Data Updates, because the user of --updates may not create users ({error}): "
                "grant it the command ACL"
            )

    def _make_archive_users(self) -> None:
        """On MongoDB: a user and collections for each app; all share the archive where none can be made."""
        if not keeps_archives(self.plan.archive):
            return
        from sdnator.rights.mongo_keeper import MongoRightsKeeper, apps_url

        identities = self._parts.identities
        keeper = MongoRightsKeeper(self.plan.archive, identities)
        try:
            keeper.apply()
        except RightsRefused as error:
            self._tell(f"every app may read and write all of Data Archives: {redacted(str(error))}")
        else:
            self._parts.archive_of = partial(apps_url, self.plan.archive, identities)
            keeper.start()
            self._stack.callback(keeper.stop)

    @property
    def archive(self) -> str:
        """URL of Data Archives for the operator; may hold a password."""
        return self._parts.archive_of(OPERATOR)

    @property
    def plan(self) -> StandingPlan:
        """What holds now."""
        return self._parts.plan

    @property
    def updates(self) -> str:
        """URL of Data Updates; may hold a password."""
        return self._parts.updates

    @property
    def coordinator(self) -> str:
        """URL of the Coordinator's HTTP API."""
        try:
            return self._parts.address_file.read_text(encoding="utf-8")
        except OSError:
            return ""

    @property
    def switch_addresses(self) -> dict[str, str]:
        """Of the P4Runtime servers, by switch."""
        return {one.name: self._parts.switch_address(one) for one in self.plan.switches}

    @property
    def switch_securities(self) -> dict[str, dict[str, Any]]:
        """How channels to each switch are secured."""
        return {one.name: asdict(self._parts.security_of(one)) for one in self.plan.switches}

    @property
    def dashboard(self) -> str:
        """URL of the dashboard; empty where there is none."""
        return self.endpoints("dashboard").get("dashboard", "")

    @property
    def uncontrolled(self) -> str:
        """Switches that the controller had not under control when it was ready, and why; empty: none."""
        return self.endpoints("uncontrolled").get("p4runtime_ctrl", "")

    def endpoints(self, what: str) -> dict[str, str]:
        """Addresses from the parts' ready lines, by part: `metrics`, `http`."""
        said = {report.name: self._supervisor.said(report.name) for report in self.reports()}
        return {name: str(line[what]) for name, line in said.items() if line.get(what)}

    def pids(self) -> dict[str, int]:
        """Process ids by name; the last one if a part does not run."""
        return self._supervisor.pids()

    def reports(self) -> list[PartReport]:
        """State of every part."""
        return self._supervisor.reports()

    def logs(self) -> dict[str, tuple[int, int]]:
        """By part: bytes of its logs, and lines that were suppressed."""
        return self._supervisor.logs()

    def watch(self) -> bool:
        """Restart parts that have died or hang; True if anything has changed.  Never blocks."""
        for text in self._keeper.told():
            self._tell(text)
        return self._supervisor.watch()

    @property
    def refusals(self) -> Mapping[str, int]:
        """By identity: commands that Data Updates refused for want of a right."""
        return dict(self._keeper.refusals)

    def wait(self, seconds: float) -> None:
        """Return after a time limit, or as soon as a part has become ready or has ended."""
        self._supervisor.wait(seconds)

    def reload(self, plan: StandingPlan) -> None:
        """Apply the changes of another plan that can be applied now, and report the rest."""
        found = changes(self.plan, plan)
        self._parts.plan = taken_up(self.plan, plan, found.again)
        for name in found.again:
            self._supervisor.renew(name)
        for text in found.waits:
            self._tell(text)
        self._tell(f"restarted with new settings: {', '.join(found.again) or 'nothing'}")

    def stop(self) -> None:
        """Stop all parts, the last started first."""
        try:
            self._supervisor.stop()
        finally:
            self._stack.close()
