"""A campaign of damaged files against every reader of travjax: `python -m tests.fuzz`.

formats.py:   a valid file of each kind and the reader that it is for; a new kind of file is one entry there
mutations.py: what is done to a file
worker.py:    a process that damages a file, has it read and judges what came out
campaign.py:  processes of that kind under limits of memory and time, and what they found
"""
