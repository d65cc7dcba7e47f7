"""Blocks of the firewall at somebody else's firewall, by signed HTTP requests whose answers confirm or refuse."""
