"""Every mistake at the command line is told in one line, names what is wrong, and leaves nothing behind."""

import re

import pytest

from jaxsand.__main__ import main

BAD = {
    "no command": ([], "arguments: "),
    "unknown command": (["dig"], "COMMAND: invalid choice: 'dig'"),
    "no goal": (["shape"], "arguments: .*goal"),
    "unknown option": (["shape", "S", "--deep"], "arguments: unrecognized arguments: --deep"),
    "unknown letter": (["shape", "é"], "letter: got 'é'"),
    "unknown sign": (["shape", "?"], "letter: got '\\?'"),
    "a word": (["shape", "SAND"], "goal: got 'SAND'.*--method strokes"),
    "nothing": (["shape", " "], "goal: got an empty name"),
    "missing map": (["shape", "none.txt"], "none.txt: no such file"),
    "missing picture": (["shape", "none.png"], "none.png: no such file"),
    "missing heights": (["shape", "none.npy"], "none.npy: no such file"),
    "empty map": (["shape", "empty.txt"], "empty.txt: got no rows"),
    "level map": (["shape", "level.txt"], "level.txt: got no cell to dig"),
    "map in pieces": (["shape", "apart.txt"], "map: got 2 pieces"),
    "ragged map": (["shape", "ragged.txt"], "ragged.txt: got 1 cells in row 2"),
    "odd sign": (["shape", "odd.txt"], "odd.txt: got 'x' in row 1"),
    "two starts": (["shape", "twostarts.txt"], "twostarts.txt: got 2 starts"),
    "binary map": (["shape", "binary.txt"], "binary.txt: cannot be read as text"),
    "broken picture": (["shape", "broken.png"], "broken.png: cannot be read as a picture"),
    "white picture": (["shape", "white.png", "--method", "plan"], "goal: .*nothing to dig"),
    "broken heights": (["shape", "broken.npy"], r"broken.npy: cannot be read as a \.npy"),
    "cube of heights": (["shape", "cube.npy"], r"cube.npy: got shape \[2, 2, 2\]"),
    "level heights": (["shape", "flat.npy", "--method", "plan"], "goal: .*nothing to dig"),
    "heights not finite": (["shape", "nan.npy", "--method", "plan"], "goal: got 144 cells that are not finite"),
    "too few heights": (["shape", "small.npy", "--method", "plan"], "goal: .*fewer than the 6"),
    "missing drawing": (["shape", "none.json"], "none.json: no such file"),
    "broken drawing": (["shape", "broken.json"], "broken.json: cannot be read as a drawing"),
    "drawing of two corners": (["shape", "corners.json"], r"shapes\[1\]\.points: got 2 of them; give the corners"),
    "drawing not finite": (["shape", "infinite.json", "--method", "search"], r"shapes\[0\]\.height: got nan; give metres"),
    "drawing on a huge grid": (["shape", "huge.json"], r"grid\.shape\[0\]: got 100000; give"),
    "drawing on no grid": (
        ["shape", "gridless.json"],
        r'grid: is missing in gridless.json; give {"shape": \[rows, columns\]',
    ),
    "drawing of two spacings": (["shape", "pit.json", "--spacing", "0.02"], "spacing: pit.json gives its own; leave"),
    "drawing with no data": (["shape", "pit.json", "--no-data", "0"], r"no-data: has an effect on \.npy files only"),
    "drawing with a start": (["shape", "pit.json", "--start", "1,1"], "start: pit.json is no map"),
    "plan of a drawing that is free": (
        ["shape", "pad.json", "--method", "plan"],
        "method: 'plan' knows no free cells, and no weights",
    ),
    "plan of a drawing with weights": (
        ["shape", "strict.json", "--method", "plan"],
        "method: 'plan' knows no free cells, and no weights",
    ),
    "strokes of a drawing": (["shape", "pit.json", "--method", "strokes"], "method: 'strokes' pushes a glyph's own strokes"),
    "start off the letter": (["shape", "S", "--start", "0,0"], r"start: got \(0, 0\)"),
    "start of one number": (["shape", "S", "--start", "3"], "start: got '3'"),
    "start for a picture": (["shape", "white.png", "--start", "1,1"], "start: .*leave --start out"),
    "unknown method": (["shape", "S", "--method", "magic"], "method: invalid choice: 'magic'"),
    "strokes of a map": (["shape", "l.txt", "--method", "strokes"], "method: 'strokes'"),
    "start of strokes": (["shape", "S", "--method", "strokes", "--start", "3,3"], "start: has no effect on"),
    "depth of strokes": (["shape", "S", "--method", "strokes", "--depth-mm", "9"], "depth-mm: has no effect on"),
    "spacing of words": (["shape", "S", "--spacing", "fine"], "spacing: got 'fine'"),
    "negative spacing": (["shape", "S", "--spacing", "-1"], "spacing: got -1.0"),
    "depth of none": (["shape", "S", "--depth-mm", "0"], "depth-mm: got 0.0"),
    "resolution of none": (["shape", "S", "--resolution", "0"], "resolution: got '0'"),
    "spacing beyond reason": (["shape", "dip.npy", "--spacing", "1e39"], r"spacing: got 1e\+39; give metres"),
    "resolution beyond reason": (["shape", "S", "--resolution", "9999"], "resolution: got 9999"),
    "goal without data": (
        ["shape", "holes.npy", "--method", "plan", "--no-data", "-9999"],
        "goal: got 12 cells that are not finite; fill .*; or use --method search or optimise, to which they are free",
    ),
    "goal that is free": (["shape", "nan.npy", "--method", "search"], "goal: got NaN, free, in every cell"),
    "free cells of a plan": (
        ["shape", "dip.npy", "--method", "plan", "--free", "cube.npy"],
        "free: has an effect with --method search, optimise",
    ),
    "free cells of a letter": (
        ["shape", "S", "--method", "search", "--free", "cube.npy"],
        r"free: has an effect on a goal in a \.npy file only",
    ),
    "free cells of another shape": (
        ["shape", "dip.npy", "--method", "search", "--free", "cube.npy"],
        r"free: got shape \[2, 2, 2\], the goal has \[12, 12\]",
    ),
    "free cells in words": (["shape", "dip.npy", "--method", "search", "--free", "words.npy"], "free: got dtype <U1"),
    "free cells of nothing": (["shape", "dip.npy", "--method", "search", "--free", "none.npy"], "none.npy: no such file"),
    "free cells of rubbish": (
        ["shape", "dip.npy", "--method", "search", "--free", "broken.npy"],
        r"free: broken.npy cannot be read as a \.npy array",
    ),
    "free cells in text": (
        ["shape", "dip.npy", "--method", "search", "--free", "land.xyz"],
        r"free: got 'land.xyz'; give a \.png \(dark is free\)",
    ),
    "surface without data": (
        ["shape", "dip.npy", "--no-data", "-9999", "--surface", "holes.npy"],
        "surface: got 12 cells that are not finite; fill",
    ),
    "no data of a letter": (["shape", "S", "--no-data", "-9999"], r"no-data: has an effect on \.npy files only"),
    "no data of no scans": (["trench", "--no-data", "-9999"], "no-data: has an effect on --measured only"),
    "elevations as text": (["shape", "land.asc"], r"goal: got 'land.asc', and \.asc is not read; .*\.npy.*first row"),
    "elevations to push a text": (["shape", "land.tif", "--method", "strokes"], r"goal: got 'land.tif', and \.tif is not"),
    "elevations of a file": (["shape", "land.xyz"], r"goal: got 'land.xyz', and \.xyz is not read"),
    "elevations to settle": (
        ["settle", "land.asc", "--out-file", "x.npy"],
        r"land.asc: \.asc is not read; give a \.npy file.*numpy\.save.*flipud",
    ),
    "elevations as a surface": (["shape", "S", "--surface", "land.tif"], r"surface: got 'land.tif'; give .*\.npy file"),
    "first row of a letter": (["shape", "S", "--first-row", "top"], r"first-row: has an effect on \.npy files only"),
    "a value for no data as a goal": (
        ["shape", "raw.npy"],
        r"raw\.npy: got 1 cells more than 0\.12 m above or below level sand, such as -9999, .*--no-data -9999",
    ),
    "a value for no data to search": (["shape", "raw.npy", "--method", "search"], r"raw\.npy: got 1 cells more than"),
    "a value for no data as a surface": (["shape", "dip.npy", "--surface", "raw.npy"], r"raw\.npy: got 1 cells more"),
    "a value for no data to settle": (
        ["settle", "raw.npy", "--out-file", "x.npy"],
        r"raw\.npy: got 1 cells more than 1\.2 m above or below -0\.01 m, such as -9999, .*--no-data -9999",
    ),
    "unknown surface": (["shape", "S", "--surface", "moon"], "surface: got 'moon'"),
    "surface of another size": (["shape", "S", "--surface", "flat.npy"], r"surface: got shape \[12, 12\]"),
    "folder under a file": (["shape", "S", "--out", "a-file/x"], "out: cannot write to a-file/x"),
    "no out file": (["settle", "pile.npy"], "arguments: .*--out-file"),
    "out file of another kind": (["settle", "pile.npy", "--out-file", "x.txt"], "out-file: got x.txt"),
    "no input": (["settle", "none.npy", "--out-file", "x.npy"], "none.npy: no such file"),
    "words to settle": (["settle", "words.npy", "--out-file", "x.npy"], "words.npy: got dtype"),
    "nan to settle": (
        ["settle", "nan.npy", "--out-file", "x.npy"],
        "nan.npy: got 144 cells that are not finite; .*--no-data nan",
    ),
    "right angle": (
        ["settle", "pile.npy", "--out-file", "x.npy", "--repose-deg", "90"],
        "repose-deg: got '90'; give degrees",
    ),
    "six neighbours": (["settle", "pile.npy", "--out-file", "x.npy", "--neighbours", "6"], "neighbours: invalid choice"),
    "spacing zero": (["settle", "pile.npy", "--out-file", "x.npy", "--spacing", "0"], "spacing: got 0.0"),
    "tolerance below zero": (["settle", "pile.npy", "--out-file", "x.npy", "--tol", "-1"], r"stop\.tolerance: got"),
    "unwritable folder": (["settle", "pile.npy", "--out-file", "a-file/x.npy"], "out: cannot write to a-file"),
    "plan of nothing": (["plan", "none.txt"], "none.txt: no such file"),
    "plan in pieces": (["plan", "apart.txt"], "map: got 2 pieces"),
    "search for a drawn goal": (["shape", "l.txt", "--method", "search"], "method: 'search' compares berms too"),
    "pushes without a search": (
        ["shape", "L", "--pushes", "9"],
        "pushes: has an effect with --method search, optimise or policy only",
    ),
    "looking ahead without a policy": (
        ["shape", "L", "--lookahead", "2"],
        "lookahead: has an effect with --method policy only",
    ),
    "pushes of a policy alone": (
        ["shape", "L", "--method", "policy", "--pushes", "9"],
        "pushes: .*add that, or leave it out",
    ),
    "fewer pushes than the policy takes": (
        ["shape", "L", "--method", "policy", "--refine", "--strokes", "3", "--pushes", "3"],
        "pushes: got 3, and the policy may take 3 for 3 strokes before --refine; give more",
    ),
    "policy for a drawn goal": (["shape", "l.txt", "--method", "policy"], "method: 'policy' compares berms too"),
    "plan to nowhere": (["plan", "l.txt", "--end", "0,2"], r"end: got \(0, 2\)"),
    "plan to no cell": (["plan", "l.txt", "--end", "here"], "end: got 'here'"),
    "plan in no time": (["plan", "l.txt", "--seconds", "0"], "seconds: got 0.0"),
    "a seed below 0": (["shape", "L", "--method", "search", "--seed", "-1"], "seed: "),
    "weight of nothing": (["plan", "l.txt", "--weight", "2"], "weight: has no effect with engine 'auto'"),
    "turns beyond price": (["plan", "l.txt", "--turn-cost", "inf"], "turn_cost: got inf"),
    "a name of blanks": (["settle", " ", "--out-file", "x.npy"], r"IN\.npy: got an empty name"),
    "a name that is too long": (
        ["settle", "x" * 300 + ".npy", "--out-file", "y.npy"],
        "x{200}: no such file; check the name",
    ),
    "unknown benchmark": (["bench", "everything"], "what: invalid choice"),
    "batch of none": (["bench", "settle", "--batch", "0"], "batch: got '0'"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_input_is_one_line_and_exit_code_2(here, capsys, name):
    arguments, message = BAD[name]
    before = sorted(here.iterdir())
    try:
        code = main(arguments)
    except SystemExit as stop:
        code = stop.code
    out, err = capsys.readouterr()
    assert code == 2
    assert out == ""
    assert err.count("\n") == 1
    assert re.match(f"error: {message}", err), err
    assert sorted(here.iterdir()) == before
