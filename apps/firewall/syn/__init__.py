"""Defence against SYN floods."""
