"""Job Creator: orders at set times."""
