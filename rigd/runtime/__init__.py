"""What the processes of a user share with the system: locks and signals."""
