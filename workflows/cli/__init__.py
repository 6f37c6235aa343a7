"""The command line `gnmreg`: parse arguments, call the library, print."""
