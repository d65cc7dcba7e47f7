"""How training packets are divided between the parts of Kitsune."""

_FEATURE_MAP_SHARE = 11


def split(packets: int) -> tuple[int, int]:
    """Packets for the feature map and for the autoencoders: one in eleven, as in the published 5,000 + 50,000."""
    feature_map = packets // _FEATURE_MAP_SHARE
    return feature_map, packets - feature_map
