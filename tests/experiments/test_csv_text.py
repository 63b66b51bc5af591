from experiments.csv_text import csv_text, number_text


def test_a_row_that_lacks_columns_leaves_them_empty():
    assert csv_text([{"a": 1, "b": 2}, {"a": 3}]) == "a,b\n1,2\n3,\n"


def test_no_rows_are_no_text():
    assert csv_text([]) == ""


def test_a_number_that_is_none_is_left_out():
    assert number_text(float("nan")) == ""
    assert number_text(1.23456) == "1.235"
