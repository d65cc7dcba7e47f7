"""Pure: orders, printers, sensors, twins and the simulation of a scenario; no socket, no clock, no thread."""
