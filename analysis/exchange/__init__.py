"""Records of other programs in, records and frequency responses out."""
