"""One drive over many processes: each makes windows of it, what needs order is made of what they found."""
