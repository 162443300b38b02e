"""Addresses of this machine only."""

import secrets

HOST = "127.0.0.1"


def random_loopback() -> str:
    """Return an address of this machine only, 127.x.y.z, which other pages cannot guess."""
    return ".".join(["127", *(str(1 + secrets.randbelow(254)) for _ in range(3))])
