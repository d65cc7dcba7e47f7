"""Job Scheduler: what each printer's queue is to hold, by one of the schedulers of `manufacturing.scheduling`."""
