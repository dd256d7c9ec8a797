"""What can be proved of a feedback on a graph and on a domain."""
