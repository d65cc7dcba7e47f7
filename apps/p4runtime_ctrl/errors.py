"""Errors between controller and switch.

ControllerError
├── ProgramError      the P4 program lacks something that the controller needs
├── CaptureTimesError the times of a capture cannot be used
├── EntryError        an entry that does not fit the program; never sent to the switch
├── TelemetryError    a packet request that the classifier cannot hold
└── SwitchError       the switch: unreachable, refused, silent
    ├── Malformed     it sent a message that does not fit its program
    ├── NotPrimary    another controller is primary
    └── Unreachable   no connection, or the connection was lost
"""


class ControllerError(Exception):
    """Base of this app's errors; the text says what, where and what to do."""


class P4InfoError(ControllerError):
    """The P4 program lacks a table, action or header that the controller needs."""


class CaptureTimesError(ControllerError):
    """The file with the times of a capture cannot be read, or holds something else."""


class EntryError(ControllerError):
    """An entry names something unknown, or a value does not fit its field."""


class TelemetryError(ControllerError):
    """The classifier cannot hold the requests."""


class SwitchError(ControllerError):
    """The switch answered with an error."""


class Malformed(SwitchError):
    """The switch sent a message that does not fit its program; it is counted and dropped."""


class NotPrimary(SwitchError):
    """Another controller is primary; this one may not write."""


class Unreachable(SwitchError):
    """There is no connection to the switch."""
