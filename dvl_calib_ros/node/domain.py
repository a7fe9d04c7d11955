"""A ROS domain of one's own, so as neither to hear nor to disturb a vehicle that is running."""

from __future__ import annotations

import random
import socket

from ..errors import InputError

# Of RTPS (DDS Interoperability Wire Protocol 2.5, section 9.6.2): port of the first participant's discovery traffic
PORT_BASE, DOMAIN_GAIN, FIRST_PARTICIPANT = 7400, 250, 10
# Above, ports are those that systems give to outgoing connections.
DOMAINS = range(1, 101)
# By domain, what keeps others from taking it until a participant is there: a name that only one socket of this host can
# have, and that is free again when its process ends, however it ends.
_taken: dict[int, socket.socket] = {}


def private_domain() -> dict[str, str]:
    """Environment variables of processes that are on a free domain and heard on this host only."""
    return {"ROS_DOMAIN_ID": str(take_domain()), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}


def take_domain() -> int:
    """Take a domain, at random, that nobody took and on which this host has no participant.

    It stays taken until `give_back` or the end of this process. Raises InputError if there is none.
    """
    for domain in random.sample(DOMAINS, len(DOMAINS)):
        if _take(domain):
            if not _has_participant(domain):
                return domain
            give_back(domain)
    raise InputError(
        f"every ROS domain from {DOMAINS[0]} to {DOMAINS[-1]} has a participant on this host; end some of them"
    )


def give_back(domain: int) -> None:
    """Let others take a domain that this process took."""
    _taken.pop(domain).close()


def _take(domain: int) -> bool:
    claim = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    try:
        claim.bind(f"\0dvl_calib_ros/domain/{domain}")
    except OSError:
        claim.close()
        return False
    _taken[domain] = claim
    return True


def _has_participant(domain: int) -> bool:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.bind(("", PORT_BASE + DOMAIN_GAIN * domain + FIRST_PARTICIPANT))
        except OSError:
            return True
    return False
