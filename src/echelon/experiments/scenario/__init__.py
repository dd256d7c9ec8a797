"""An experiment as a file: its schema, its checks, and how its parts are built."""
