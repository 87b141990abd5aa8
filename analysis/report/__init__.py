"""What people and programs are shown of an analysis: tables, figures, a JSON document."""
