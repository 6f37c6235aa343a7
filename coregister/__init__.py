"""Many registrations in, a head model out."""
