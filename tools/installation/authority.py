"""An authority in a directory: its certificate and key, and the certificates that it issues, as PEM files."""

from __future__ import annotations

import datetime
import ipaddress
import os
import secrets
from pathlib import Path
from typing import Final, Self

from buddyline.protocol.errors import BuddylineError
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

# A node without a clock of its own may be this far behind when it is switched on.
BACKDATED: Final = datetime.timedelta(days=7)


class Authority:
    """Issues certificates; its files are ca.crt and ca.key."""

    def __init__(self, directory: Path, certificate: x509.Certificate, key: ec.EllipticCurvePrivateKey) -> None:
        self.directory = directory
        self._certificate = certificate
        self._key = key

    @property
    def certificate_path(self) -> Path:
        """The certificate that every process checks the others with."""
        return self.directory / "ca.crt"

    @property
    def key_path(self) -> Path:
        """The key that signs certificates."""
        return self.directory / "ca.key"

    @classmethod
    def create(cls, directory: Path, days: int) -> Self:
        """Make a new authority; raise BuddylineError if there is one."""
        try:
            directory.mkdir(mode=0o700, parents=True, exist_ok=True)
        except OSError as error:
            raise BuddylineError(f"{directory}: cannot be made: {error.strerror}") from error
        key = ec.generate_private_key(ec.SECP256R1())
        # Every authority has its own name, so that errors distinguish a foreign certificate from a forged one.
        name = _name(f"buddyline authority {secrets.token_hex(4)}")
        identifier = x509.SubjectKeyIdentifier.from_public_key(key.public_key())
        certificate = _builder(name, name, key.public_key(), days, identifier, signs=True).sign(key, hashes.SHA256())
        authority = cls(directory, certificate, key)
        _write_pair(authority.certificate_path, certificate, authority.key_path, key)
        return authority

    @classmethod
    def open(cls, directory: Path) -> Self:
        """Read an authority; raise BuddylineError naming what is wrong with its files."""
        try:
            certificate = x509.load_pem_x509_certificate((directory / "ca.crt").read_bytes())
            key = serialization.load_pem_private_key((directory / "ca.key").read_bytes(), password=None)
        except FileNotFoundError as error:
            raise BuddylineError(f"{error.filename}: is missing; begin with `buddyline keys init`") from error
        except (OSError, ValueError, TypeError) as error:
            raise BuddylineError(f"{directory}: ca.crt or ca.key cannot be read: {error}") from error
        if not isinstance(key, ec.EllipticCurvePrivateKey) or key.public_key() != certificate.public_key():
            raise BuddylineError(f"{directory / 'ca.key'}: is not the key of ca.crt")
        return cls(directory, certificate, key)

    def ends_within(self, days: int) -> datetime.datetime | None:
        """Return its end, UTC, if it is sooner than so many days: what it issues is valid until then; else None."""
        until = self._certificate.not_valid_after_utc
        return until if datetime.datetime.now(datetime.UTC) + datetime.timedelta(days=days) > until else None

    def issue(self, name: str, days: int, server_host: str | None = None) -> list[Path]:
        """Make certificate and key for name, as a client, or as the server at server_host; return their files.

        It is valid for so many days, and no longer than the authority.
        """
        key = ec.generate_private_key(ec.SECP256R1())
        purpose = ExtendedKeyUsageOID.SERVER_AUTH if server_host else ExtendedKeyUsageOID.CLIENT_AUTH
        extensions = (
            x509.ExtendedKeyUsage([purpose]),
            x509.SubjectAlternativeName([_general_name(server_host or name)]),
            x509.AuthorityKeyIdentifier.from_issuer_public_key(self._key.public_key()),
        )
        until = self.ends_within(days) or days
        builder = _builder(_name(name), self._certificate.subject, key.public_key(), until, *extensions, signs=False)
        paths = [self.directory / f"{name}.crt", self.directory / f"{name}.key"]
        _write_pair(paths[0], builder.sign(self._key, hashes.SHA256()), paths[1], key)
        return paths

    def issued(self) -> list[tuple[str, datetime.datetime]]:
        """Return the names of the certificates in its folder, its own left out, and when each ends, UTC."""
        found = []
        for path in sorted(self.directory.glob("*.crt")):
            if path != self.certificate_path:
                try:
                    certificate = x509.load_pem_x509_certificate(path.read_bytes())
                except (OSError, ValueError) as error:
                    raise BuddylineError(f"{path}: cannot be read: {error}") from error
                found.append((path.stem, certificate.not_valid_after_utc))
        return found

    def hub_host(self) -> str:
        """Return where clients find the hub, as its certificate says."""
        path = self.directory / "hub.crt"
        try:
            certificate = x509.load_pem_x509_certificate(path.read_bytes())
            names = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
            host = next(iter(names)).value
        except (OSError, ValueError, x509.ExtensionNotFound) as error:
            raise BuddylineError(f"{path}: cannot be read: {error}") from error
        return f"[{host}]" if isinstance(host, ipaddress.IPv6Address) else str(host)


def _builder(
    subject: x509.Name,
    issuer: x509.Name,
    key: ec.EllipticCurvePublicKey,
    until: datetime.datetime | int,
    *extensions: x509.ExtensionType,
    signs: bool,
) -> x509.CertificateBuilder:
    """Return a certificate to sign; until: its end, or days; signs: whether its owner may sign other certificates."""
    now = datetime.datetime.now(datetime.UTC)
    usage = dict.fromkeys(
        ("content_commitment", "key_encipherment", "data_encipherment", "key_agreement", "encipher_only"), False
    )
    builder = (
        x509.CertificateBuilder(issuer, subject, key, x509.random_serial_number())
        .not_valid_before(now - BACKDATED)
        .not_valid_after(now + datetime.timedelta(days=until) if isinstance(until, int) else until)
        .add_extension(x509.BasicConstraints(ca=signs, path_length=0 if signs else None), critical=True)
        .add_extension(
            x509.KeyUsage(
                digital_signature=not signs, key_cert_sign=signs, crl_sign=signs, decipher_only=False, **usage
            ),
            critical=True,
        )
    )
    for extension in extensions:
        builder = builder.add_extension(extension, critical=False)
    return builder


def _name(common_name: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, common_name)])


def _general_name(host: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(host.strip("[]")))
    except ValueError:
        return x509.DNSName(host)


def _write_pair(
    certificate_path: Path, certificate: x509.Certificate, key_path: Path, key: ec.EllipticCurvePrivateKey
) -> None:
    for path in (certificate_path, key_path):
        if path.exists():
            raise BuddylineError(f"{path}: exists; no key is ever overwritten, move it away first")
    pem = key.private_bytes(serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption())
    path = key_path
    try:
        # The file has its mode before it has content, so no other user can open it in between.
        with open(os.open(key_path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as file:
            file.write(pem)
        path = certificate_path
        certificate_path.write_bytes(certificate.public_bytes(serialization.Encoding.PEM))
    except FileExistsError as error:
        raise BuddylineError(f"{path}: exists; no key is ever overwritten, move it away first") from error
    except OSError as error:
        # Neither was there before.
        for written in (certificate_path, key_path):
            written.unlink(missing_ok=True)
        raise BuddylineError(f"{path}: cannot be written: {error.strerror}") from error
