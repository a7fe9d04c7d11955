"""A ROS domain of one's own, so as neither to hear nor to disturb a vehicle that is running."""

from __future__ import annotations

import random
import socket

from ..errors import InputError

# Of RTPS (DDS Interoperability Wire Protocol 2.5, section 9.6.2): port of the first participant's discovery traffic
PORT_BASE, DOMAIN_GAIN, FIRST_PARTICIPANT = 7400, 250, 10
# Above, ports are those that systems give to outgoing connections.
DOMAINS = range(1, 101)


def private_domain() -> dict[str, str]:
    """Environment variables of processes that are on a free domain and heard on this host only."""
    return {"ROS_DOMAIN_ID": str(free_domain()), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}


def free_domain() -> int:
    """A domain, at random, on which this host has no participant. Raises InputError if there is none."""
    for domain in random.sample(DOMAINS, len(DOMAINS)):
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            try:
                probe.bind(("", PORT_BASE + DOMAIN_GAIN * domain + FIRST_PARTICIPANT))
            except OSError:
                continue
        return domain
    raise InputError(
        f"every ROS domain from {DOMAINS[0]} to {DOMAINS[-1]} has a participant on this host; end some of them"
    )
