"""Extra ``rescue``: read damaged bags beyond the damage."""
