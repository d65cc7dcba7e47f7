"""A CA of this installation and the certificates that it signs, for P4Runtime over TCP.

folder (0700) ── ca.pem, ca.key ──► NAME.pem, NAME.key (0600)
                                     ├─ of a switch: names and addresses under which it is reached
                                     └─ of a client: its name (CN) is its role
"""

import datetime as dt
import ipaddress
import re
from collections.abc import Sequence
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.serialization import (
    Encoding,
    NoEncryption,
    PrivateFormat,
    load_pem_private_key,
)
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from due.private_files import write_private
from sdnator.errors import BadInput

CA = "ca"
_CA_DAYS = 3_650
_NAME = re.compile(r"[A-Za-z0-9_.-]{1,64}")
_MOST_DAYS = 3_650


class CertificateFolder:
    """The CA in a folder, and what it signs.

    Args:
        folder: made with mode 0700 where it is missing.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def make_ca(self) -> None:
        """Make the CA.  Raises BadInput where there is one already, or the folder cannot be written."""
        if self._file(CA, "key").exists():
            raise BadInput(
                f"{self.folder} already holds a CA: `sdnator cert add` issues more certificates from it; to start over, "
                "remove the folder, which makes all of its certificates invalid"
            )
        key = ec.generate_private_key(ec.SECP256R1())
        name = _named("SDNator CA")
        usage = x509.KeyUsage(
            digital_signature=True, content_commitment=False, key_encipherment=False, data_encipherment=False,
            key_agreement=False, key_cert_sign=True, crl_sign=True, encipher_only=False, decipher_only=False,
        )  # fmt: skip
        builder = (
            _builder(name, name, key.public_key(), _CA_DAYS)
            .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
            .add_extension(usage, critical=True)
            .add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
        )
        self._write(CA, key, builder.sign(key, hashes.SHA256()))

    def issue(self, name: str, *, hosts: Sequence[str] = (), days: int = 825) -> None:
        """Make a certificate; one of that name is replaced.

        Args:
            name: its CN, and of its files.
            hosts: names and addresses under which a switch is reached; empty: it is a client's.
            days: for which it is valid.

        Raises:
            BadInput: a name that cannot be one, no CA here, or a folder that cannot be written.
        """
        if not _NAME.fullmatch(name) or name == CA:
            raise BadInput(
                f"{name!r}: a certificate's name has 1 to 64 letters, digits, . _ and -, and is not {CA}"
            )
        if not 1 <= days <= _MOST_DAYS:
            raise BadInput(f"--days {days}: give 1 to {_MOST_DAYS}")
        ca_key, ca = self._ca()
        key = ec.generate_private_key(ec.SECP256R1())
        purpose = ExtendedKeyUsageOID.SERVER_AUTH if hosts else ExtendedKeyUsageOID.CLIENT_AUTH
        builder = (
            _builder(_named(name), ca.subject, key.public_key(), days)
            .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
            .add_extension(x509.ExtendedKeyUsage([purpose]), critical=False)
            .add_extension(
                x509.AuthorityKeyIdentifier.from_issuer_public_key(ca_key.public_key()), critical=False
            )
        )
        if hosts:
            names = x509.SubjectAlternativeName([_general(host) for host in hosts])
            builder = builder.add_extension(names, critical=False)
        self._write(name, key, builder.sign(ca_key, hashes.SHA256()))

    def _ca(self) -> tuple[ec.EllipticCurvePrivateKey, x509.Certificate]:
        try:
            key = load_pem_private_key(self._file(CA, "key").read_bytes(), password=None)
            certificate = x509.load_pem_x509_certificate(self._file(CA, "pem").read_bytes())
        except (OSError, ValueError) as error:
            raise BadInput(
                f"{self.folder} holds no CA that can be used ({error}); `sdnator cert init` makes one"
            ) from None
        if not isinstance(key, ec.EllipticCurvePrivateKey):
            raise BadInput(f"{self._file(CA, 'key')}: not a key that `sdnator cert init` made")
        return key, certificate

    def _write(self, name: str, key: ec.EllipticCurvePrivateKey, certificate: x509.Certificate) -> None:
        private = key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption()).decode()
        try:
            self.folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            write_private(self._file(name, "key"), private)
            write_private(self._file(name, "pem"), certificate.public_bytes(Encoding.PEM).decode())
        except OSError as error:
            raise BadInput(
                f"{error.filename or self.folder}: cannot be written ({error.strerror}); give another folder"
            ) from None

    def _file(self, name: str, kind: str) -> Path:
        return self.folder / f"{name}.{kind}"


def _named(name: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])


def _builder(
    subject: x509.Name, issuer: x509.Name, key: ec.EllipticCurvePublicKey, days: int
) -> x509.CertificateBuilder:
    now = dt.datetime.now(dt.UTC)
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(key)
        .serial_number(x509.random_serial_number())
        # clocks of switches differ from ours
        .not_valid_before(now - dt.timedelta(hours=1))
        .not_valid_after(now + dt.timedelta(days=days))
    )


def _general(host: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(host))
    except ValueError:
        pass
    try:
        return x509.DNSName(host)
    except ValueError as error:
        raise BadInput(f"--host {host}: {error}") from None
