"""The `curation` command: one file a subcommand."""
