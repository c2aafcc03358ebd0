"""What is seen of a run from outside, while it goes on: messages in, a state out, and a table of it.

`scene` is all that is seen, `book` what the bound says of it, `table` what a terminal shows, `lines` what a file gets.
None of them knows a clock or a network.
"""
