"""One experiment many times: what varies, what each run comes to, and all of it as a dataset."""
