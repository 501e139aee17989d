"""The `packuv` command: what each of its words does, and what the terminal shows."""
