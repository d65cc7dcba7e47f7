"""A real SYN flood against a real TCP service, without the product and with it."""
