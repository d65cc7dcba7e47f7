"""State of `sdnator up` while it runs: the run file, and metrics of its parts."""

import os
from collections.abc import Mapping
from contextlib import ExitStack
from typing import TYPE_CHECKING, Any

from due.errors import DueError
from due.status_server import StatusServer, metrics_token
from sdnator.errors import BadInput
from sdnator.northbound import without_user
from sdnator.supervisor.metrics import part_metrics
from sdnator.up import running
from sdnator.up.metrics_targets import write_targets

if TYPE_CHECKING:
    from sdnator.up.pipeline import StandingPipeline


class UpReport:
    """Run file and metrics of one pipeline.  Raises BadInput if the metrics' address cannot be bound.

    Args:
        pipeline: that runs.
        config: the file that was read; empty: none.
        started: UTC, ns.
        stack: the metrics' server ends with it.
    """

    def __init__(self, pipeline: "StandingPipeline", config: str, started: int, stack: ExitStack) -> None:
        self._pipeline = pipeline
        self._config = config
        self._started = started
        self._server: StatusServer | None = None
        if host := pipeline.plan.metrics_host:
            try:
                token = metrics_token(pipeline.plan.metrics_token_file)
                self._server = StatusServer(f"[{host}]:0" if ":" in host else f"{host}:0", token)
            except DueError as error:
                raise BadInput(str(error)) from None
            stack.callback(self._server.close)
            self._server.start()

    def write(self) -> running.Running:
        """Update both."""
        pipeline, plan = self._pipeline, self._pipeline.plan
        reports, logs = pipeline.reports(), pipeline.logs()
        if self._server is not None:
            degraded = [one.name for one in reports if one.state == "degraded"]
            self._server.report(part_metrics(reports, logs), {"pid": os.getpid(), "degraded": degraded})
        switches = self._switches()
        metrics = self._metrics()
        found = running.Running(
            pid=os.getpid(),
            started=self._started,
            updates=pipeline.updates,
            archive=pipeline.archive,
            coordinator=pipeline.coordinator,
            switch=switches[0],
            switches=switches,
            parts=pipeline.pids(),
            health={
                one.name: {
                    "state": one.state,
                    "restarts": one.restarts,
                    "cause": one.cause,
                    "log_bytes": logs.get(one.name, (0, 0))[0],
                    "suppressed_lines": logs.get(one.name, (0, 0))[1],
                    "out_of_range": one.out_of_range,
                }
                for one in reports
            },
            logs=str(plan.state / "logs"),
            dashboard=pipeline.dashboard,
            token_file=str((plan.dashboard or {}).get("token_file", "")),
            metrics=metrics,
            config=self._config,
            model=pipeline.endpoints("model").get("kitsune", ""),
        )
        running.write(plan.state, found)
        write_targets(plan.metrics_targets, metrics)
        return found

    def _switches(self) -> list[dict[str, Any]]:
        addresses, securities = self._pipeline.switch_addresses, self._pipeline.switch_securities
        return [
            {
                "name": one.name,
                "address": addresses[one.name],
                "device_id": one.device_id,
                "security": securities[one.name],
                "target": one.kind,
                "ports": {str(number): kind for number, kind in one.ports.items()},
                "forward": {str(number): egress for number, egress in one.forward.items()},
            }
            for one in self._pipeline.plan.switches
        ]

    def _metrics(self) -> Mapping[str, str]:
        return {
            "coordinator": without_user(self._pipeline.coordinator).removeprefix("http://"),
            **self._pipeline.endpoints("metrics"),
            **({"supervisor": self._server.address} if self._server is not None else {}),
        }
