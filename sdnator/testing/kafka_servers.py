"""Real Kafka brokers (KRaft) on loopback, from Kafka's own jars; secured ones have TLS, users and an authorizer.

The jars are those of `$KAFKA_HOME/libs`; without it, Maven copies them once into a cache folder.
"""

import base64
import os
import secrets
import shutil
import signal
import subprocess
import time
import uuid
from pathlib import Path
from types import TracebackType
from typing import Self
from urllib.parse import urlencode

from confluent_kafka import KafkaException
from confluent_kafka.admin import AdminClient

from apps.sonata_adapter.host.maven_jars import MavenMissing, maven_jars
from due.drivers.kafka_names import parse_kafka_url
from due.private_files import write_private
from sdnator.rights.certificates import CA, CertificateFolder
from sdnator.testing.ports import free_port

KAFKA_VERSION = "3.9.1"
_START_SECONDS = 120
_STOP_SECONDS = 20
_HEAP = "-Xmx256m"
_QUICK_START = ("-XX:+UseSerialGC", "-XX:TieredStopAtLevel=1", "-Xshare:auto")
_ADMIN = "admin"
_BROKER = "broker"
_LOGIN = "org.apache.kafka.common.security"


class KafkaMissing(RuntimeError):
    """Kafka cannot be started on this machine; the text says what is missing."""


def kafka_jars() -> Path:
    """The folder that holds Kafka's jars; copies them with Maven where there are none yet.

    Returns:
        `$KAFKA_HOME/libs`, or a folder under `$XDG_CACHE_HOME` (default: ~/.cache).

    Raises:
        KafkaMissing: Java or Maven is not installed, or Maven cannot reach its repository.
    """
    if shutil.which("java") is None:
        raise KafkaMissing("Kafka needs Java (on Debian: openjdk-17-jre-headless)")
    if os.environ.get("KAFKA_HOME"):
        return Path(os.environ["KAFKA_HOME"]) / "libs"
    try:
        return maven_jars("org.apache.kafka", "kafka_2.13", KAFKA_VERSION, name="kafka")
    except MavenMissing as error:
        raise KafkaMissing(f"{error}; or set $KAFKA_HOME") from None


class KafkaServers:
    """A cluster of brokers, each a process that is broker and controller.

    Args:
        folder: for settings, logs and data.
        brokers: how many, 1 to 5.
        secured: clients need TLS and a user, and users rights; `admin_url` may do everything.
    """

    def __init__(self, folder: Path, brokers: int = 1, *, secured: bool = False) -> None:
        self._folder = folder
        self._password = secrets.token_urlsafe(24) if secured else ""
        self._jars = kafka_jars()
        # not with a "-" in front, which Kafka's tool takes for an option
        self._cluster = "c" + base64.urlsafe_b64encode(uuid.uuid4().bytes).decode().rstrip("=")[1:]
        self._ports = [(free_port(), free_port()) for _ in range(brokers)]
        self._processes: dict[int, subprocess.Popen[bytes]] = {}

    @property
    def servers(self) -> str:
        """HOST:PORT of all brokers, separated by commas."""
        return ",".join(f"127.0.0.1:{port}" for port, _ in self._ports)

    @property
    def url(self) -> str:
        """For `set_pubsub`; without a user."""
        if not self._password:
            return f"kafka://{self.servers}"
        certificate = self._folder / "certificates" / f"{CA}.pem"
        return f"kafkas://{self.servers}?{urlencode({'ssl_ca_certs': certificate})}"

    @property
    def admin_url(self) -> str:
        """The same with the credential of a super user."""
        return self.url.replace("://", f"://{_ADMIN}:{self._password}@") if self._password else self.url

    def start(self) -> Self:
        """Format the brokers' folders, start them all and wait until each answers.

        Raises:
            KafkaMissing: a broker ended, or did not answer in time; the text has its last words.
        """
        if self._password:
            self._make_certificates()
        for number in range(len(self._ports)):
            self._prepare(number)
            self.start_broker(number)
        self.wait(len(self._ports))
        return self

    def start_broker(self, number: int) -> None:
        """Start one broker, as after `kill`; returns at once."""
        home = self._home(number)
        with (home / "log").open("ab") as log:
            self._processes[number] = subprocess.Popen(
                self._java("kafka.Kafka", home / "server.properties"),
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                cwd=home,
            )

    def wait(self, brokers: int) -> None:
        """Return when this many brokers are in the cluster."""
        admin = AdminClient(parse_kafka_url(self.admin_url).client(log_level=0))
        deadline = time.monotonic() + _START_SECONDS
        while time.monotonic() < deadline:
            ended = [number for number, process in self._processes.items() if process.poll() is not None]
            if ended:
                break
            try:
                if len(admin.list_topics(timeout=1).brokers) >= brokers:
                    return
            except KafkaException:
                time.sleep(0.1)
        said = [(self._home(n) / "log").read_text(errors="replace")[-500:] for n in self._processes]
        self.stop()
        raise KafkaMissing(f"Kafka did not start: {said}")

    def kill(self, number: int) -> None:
        """kill -9 of one broker."""
        process = self._processes.pop(number)
        process.send_signal(signal.SIGKILL)
        process.wait()

    def freeze(self, number: int, *, frozen: bool = True) -> None:
        """Stop one broker as a hung machine would, or let it go on."""
        self._processes[number].send_signal(signal.SIGSTOP if frozen else signal.SIGCONT)

    def stop(self) -> None:
        """End all brokers; the folder stays."""
        for process in self._processes.values():
            process.terminate()
        for process in self._processes.values():
            try:
                process.wait(_STOP_SECONDS)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
        self._processes.clear()

    def __enter__(self) -> Self:
        return self.start()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()

    def _home(self, number: int) -> Path:
        return self._folder / f"broker-{number}"

    def _prepare(self, number: int) -> None:
        home = self._home(number)
        home.mkdir(parents=True, exist_ok=True)
        port, controller_port = self._ports[number]
        copies = min(3, len(self._ports))
        voters = ",".join(f"{at}@127.0.0.1:{own}" for at, (_, own) in enumerate(self._ports))
        settings = {
            "process.roles": "broker,controller",
            "node.id": number,
            "listeners": f"PLAINTEXT://127.0.0.1:{port},CONTROLLER://127.0.0.1:{controller_port}",
            "advertised.listeners": f"PLAINTEXT://127.0.0.1:{port}",
            "controller.listener.names": "CONTROLLER",
            "listener.security.protocol.map": "PLAINTEXT:PLAINTEXT,CONTROLLER:PLAINTEXT",
            "controller.quorum.voters": voters,
            "log.dirs": home / "data",
            "offsets.topic.replication.factor": copies,
            "offsets.topic.num.partitions": 4,
            "transaction.state.log.replication.factor": copies,
            "transaction.state.log.min.isr": 1,
            # a dead broker is noticed after 2 s instead of 9
            "broker.session.timeout.ms": 2000,
            "broker.heartbeat.interval.ms": 500,
            "controller.quorum.election.timeout.ms": 500,
            "controller.quorum.fetch.timeout.ms": 1000,
            "log.cleaner.dedupe.buffer.size": 4 << 20,
            "num.network.threads": 2,
            "num.io.threads": 2,
            **(self._guarded(port, controller_port) if self._password else {}),
        }
        path = home / "server.properties"
        write_private(path, "".join(f"{name}={value}\n" for name, value in settings.items()))
        format_it = ["format", "-t", self._cluster, "-c", path]
        if self._password:
            format_it += ["--add-scram", f"SCRAM-SHA-512=[name={_ADMIN},password={self._password}]"]
        subprocess.run(
            self._java("kafka.tools.StorageTool", *format_it),
            check=True,
            capture_output=True,
            timeout=_START_SECONDS,
        )

    def _make_certificates(self) -> None:
        folder = CertificateFolder(self._folder / "certificates")
        folder.make_ca()
        folder.issue(_BROKER, hosts=["127.0.0.1", "localhost"])
        parts = [(folder.folder / f"{_BROKER}.{kind}").read_text() for kind in ("key", "pem")]
        write_private(self._folder / "broker.pem", "".join(parts))

    def _guarded(self, port: int, controller_port: int) -> dict[str, object]:
        """Settings of a broker that lets nobody do what it was not granted."""
        known = f'username="{_ADMIN}" password="{self._password}"'
        return {
            "listeners": f"CLIENTS://127.0.0.1:{port},CONTROLLER://127.0.0.1:{controller_port}",
            "advertised.listeners": f"CLIENTS://127.0.0.1:{port}",
            "listener.security.protocol.map": "CLIENTS:SASL_SSL,CONTROLLER:SASL_SSL",
            "inter.broker.listener.name": "CLIENTS",
            "sasl.mechanism.inter.broker.protocol": "SCRAM-SHA-512",
            "sasl.mechanism.controller.protocol": "PLAIN",
            "listener.name.clients.sasl.enabled.mechanisms": "SCRAM-SHA-512",
            "listener.name.clients.scram-sha-512.sasl.jaas.config": (
                f"{_LOGIN}.scram.ScramLoginModule required {known};"
            ),
            "listener.name.controller.sasl.enabled.mechanisms": "PLAIN",
            "listener.name.controller.plain.sasl.jaas.config": (
                f'{_LOGIN}.plain.PlainLoginModule required {known} user_{_ADMIN}="{self._password}";'
            ),
            "ssl.keystore.type": "PEM",
            "ssl.keystore.location": self._folder / "broker.pem",
            "ssl.truststore.type": "PEM",
            "ssl.truststore.location": self._folder / "certificates" / f"{CA}.pem",
            "authorizer.class.name": "org.apache.kafka.metadata.authorizer.StandardAuthorizer",
            "super.users": f"User:{_ADMIN}",
        }

    def _java(self, program: str, *arguments: object) -> list[str]:
        return ["java", _HEAP, *_QUICK_START, "-cp", f"{self._jars}/*", program, *map(str, arguments)]
