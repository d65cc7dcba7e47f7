"""Pure: datagrams of NetFlow v5, NetFlow v9, IPFIX and sFlow v5 as columns; no socket, no clock, no thread."""
