"""What the rows of a study say: tables, tests and conclusions."""
