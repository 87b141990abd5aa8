"""What the loop talks to: contracts, their parameters, and the registry of drivers."""
