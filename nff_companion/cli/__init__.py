"""The command ``nff``: one file a group of commands."""
