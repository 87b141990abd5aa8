"""The live view: a process that shows the samples in Rerun and that nothing waits for."""
