"""The demo log and the recipe that makes it. Not part of the installed package."""
