"""Tools of a checkout: generators, fuzzers, measurements. No part of the installed package."""
