"""Runs of the five apps: in one process, or as processes under the Coordinator; the page and the report.

Production ──► MachineAssets, DataDriver, DigitalTwins, JobCreator, JobScheduler
    └── Watcher ◄── reports, fleet ──► page (live Gantt chart), Outcome of the run
"""
