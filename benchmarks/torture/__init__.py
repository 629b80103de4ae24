"""What bevviz makes of bags and messages that are not as they should be, beside what others make of them."""
