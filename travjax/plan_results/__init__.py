"""What becomes of a plan: files, figures and tables in a folder, and how long planning takes.

Plans, or the reason why there is none, come in; what users and other tools read goes out. It stands on `planning`.
"""
