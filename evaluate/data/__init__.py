"""What observers say of a record: a run without truth."""
