"""Options, flows and the `packuv` command."""
