"""Additive manufacturing on SDNator: a second domain on the same DUE and Coordinator.

    job_creator ──orders──► scheduler ──assignments──► data_driver ──REST──► machine_assets (printers)
                               ▲                          │
                               └── digital_twins ◄────────┘ reports, sensors

`core/` holds what is pure: printers, twins, the simulation of a whole scenario.  `scheduling/` holds the four
schedulers and the bound.  The five apps wrap them; each begins with INTERESTS and CAPABILITIES.
"""
