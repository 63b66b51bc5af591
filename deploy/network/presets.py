"""Networks with a name, and where their numbers come from.

Measured by others: over 47,000 devices on a campus, the round trip of the WiFi hop alone has a median of 3 ms and a
90th percentile of 20 ms (Sui et al., "Characterizing and Improving WiFi Latency in Large-Scale Operational Networks",
MobiSys 2016, doi:10.1145/2906388.2906393); on another, more than half of the TCP packets met more than 20 ms there
(Pei et al., "WiFi can be the weakest link of round trip network latency in the wild", INFOCOM 2016). From the
standards: the bit rates on the air, of which headers, acknowledgements and waiting for the channel leave about 60 % to
IP packets. What is neither is an assumption, and is called one.

- ``ideal``: nothing is delayed, lost or limited.
- ``lan``: a cable and a switch. 100 Mbit/s is Fast Ethernet (IEEE 802.3u); 0.2 ms is an assumption.
- ``wifi_good``: an access point in the same room, and nobody else. 1.5 ms is half of the median round trip; 80 Mbit/s
  is 60 % of two streams of IEEE 802.11n at 20 MHz (130 Mbit/s). Jitter and loss are assumptions: radios repeat what is
  not acknowledged, so that little is lost.
- ``wifi_office``: some walls away, and shared. 40 Mbit/s is 60 % of one such stream (65 Mbit/s); delay, jitter and
  loss are assumptions between the other two.
- ``wifi_bad``: a busy channel. 20 ms is the 90th percentile, and what more than half of the packets met on the other
  campus; 12 Mbit/s is half of 24 Mbit/s, the fastest rate that every IEEE 802.11a/g radio must know. Jitter and loss
  are assumptions.
- ``outage``: a quiet link that is silent for 1 s out of 20 s, which no radio is on time: it shows what a silence does,
  and is not meant to look like any place.
"""

from __future__ import annotations

from deploy.network.conditions import DirectionConditions, NetworkConditions


def _both(direction: DirectionConditions, outage_every_s: float = 0.0, outage_s: float = 0.0) -> NetworkConditions:
    return NetworkConditions(direction, direction, outage_every_s, outage_s)


PRESETS: dict[str, NetworkConditions] = {
    "ideal": _both(DirectionConditions()),
    "lan": _both(DirectionConditions(delay_ms=0.2, rate_mbit=100.0)),
    "wifi_good": _both(DirectionConditions(delay_ms=1.5, jitter_ms=0.5, loss=0.002, rate_mbit=80.0)),
    "wifi_office": _both(DirectionConditions(delay_ms=3.0, jitter_ms=2.0, loss=0.005, rate_mbit=40.0)),
    "wifi_bad": _both(DirectionConditions(delay_ms=20.0, jitter_ms=15.0, loss=0.02, rate_mbit=12.0)),
    "outage": _both(DirectionConditions(delay_ms=3.0, rate_mbit=20.0), outage_every_s=20.0, outage_s=1.0),
}
"""Named conditions, the same in each direction."""
