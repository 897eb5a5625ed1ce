"""Sign with the key of a node's certificate, and check such signatures. Needs the package cryptography."""

from __future__ import annotations

import base64
import binascii
from functools import lru_cache
from pathlib import Path
from typing import Final

from buddyline.protocol.security import SecurityError, Tls, node_name
from cryptography import x509
from cryptography.exceptions import InvalidSignature, UnsupportedAlgorithm
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID

_UNREADABLE: Final = (ValueError, TypeError, UnsupportedAlgorithm, x509.InvalidVersion)


class Signer:
    """A node's identity that signs. certificate: in PEM, to check the signatures with."""

    def __init__(self, certificate: str, key: ec.EllipticCurvePrivateKey) -> None:
        self.certificate = certificate
        self._key = key

    @classmethod
    def of(cls, tls: Tls) -> Signer:
        """Return the identity's signer; raise SecurityError naming the file and its fault."""
        try:
            certificate = Path(tls.certificate).read_text(encoding="ascii")
            key = serialization.load_pem_private_key(Path(tls.key).read_bytes(), password=None)
        except (OSError, ValueError, TypeError) as error:
            raise SecurityError(f"{tls.key}: cannot be used to sign: {error}") from error
        if not isinstance(key, ec.EllipticCurvePrivateKey):
            raise SecurityError(f"{tls.key}: cannot be used to sign: is no key of an elliptic curve")
        return cls(certificate, key)

    def sign(self, data: bytes) -> str:
        """Return the signature of data, in base64."""
        return base64.b64encode(self._key.sign(data, ec.ECDSA(hashes.SHA256()))).decode()


class Trust:
    """Whose signatures count: those with a certificate of the authority. authority: PEM file; None: any authority's."""

    def __init__(self, authority: Path | str | None = None) -> None:
        self._authority: x509.Certificate | None = None
        if authority is not None:
            try:
                self._authority = x509.load_pem_x509_certificate(Path(authority).read_bytes())
            except OSError as error:
                raise SecurityError(f"{authority}: cannot be read: {error.strerror}") from error
            except ValueError as error:
                raise SecurityError(f"{authority}: is not a certificate in PEM: {error}") from error

    def refuses(self, node: str, certificate: str, signature: str, data: bytes) -> str:
        """Return why this is not node's signature of data; "" if it is."""
        key = _key_of(certificate, node_name(node), self._authority)
        if isinstance(key, str):
            return key
        try:
            decoded = base64.b64decode(signature, validate=True)
            # The last character before the padding has bits that count for nothing (RFC 4648, section 3.5).
            if base64.b64encode(decoded) != signature.encode():
                return "its signature is not as its node wrote it"
            key.verify(decoded, data, ec.ECDSA(hashes.SHA256()))
        except (InvalidSignature, binascii.Error, ValueError):
            return "its signature is not of its certificate's key"
        return ""


@lru_cache(maxsize=64)
def _key_of(certificate: str, name: str, authority: x509.Certificate | None) -> ec.EllipticCurvePublicKey | str:
    """Return the key in a certificate of this name; in words, why it does not count."""
    try:
        found = x509.load_pem_x509_certificate(certificate.encode())
        names = [str(one.value) for one in found.subject.get_attributes_for_oid(NameOID.COMMON_NAME)]
        key = found.public_key()
    except _UNREADABLE:
        return "its certificate cannot be read"
    if names != [name]:
        return f"its certificate is of {', '.join(names) or 'nobody'}"
    if not isinstance(key, ec.EllipticCurvePublicKey):
        return "its certificate has no key of an elliptic curve"
    if authority is not None:
        try:
            found.verify_directly_issued_by(authority)
        except (InvalidSignature, *_UNREADABLE):
            return "its certificate is of another authority"
    return key
