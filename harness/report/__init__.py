"""What the runs show, as tables and figures."""
