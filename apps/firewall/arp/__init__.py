"""Address owners, learnt from ARP."""
