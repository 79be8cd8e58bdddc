"""Points in a text however it is spelled, and the one line for each that is none."""

import numpy as np
import pytest

from tests.points import CELL, SOUTH, WEST, line_of, points_of, read, refusal, uneven, write_text
from travjax.point_clouds.clouds import SUFFIXES
from travjax.simulation.grid import Grid

PLAIN = "0 0 1\n1 0 2\n0 1 3\n1 1 4\n"
SPELLINGS = {
    "blanks": PLAIN,
    "tabs, blanks and empty lines": "\n0\t0  1\n1 0 2\n\n0 1 3 \n 1 1 4",
    "Windows lines": PLAIN.replace("\n", "\r\n"),
    "commas": PLAIN.replace(" ", ","),
    "commas and blanks": PLAIN.replace(" ", ", "),
    "semicolons": PLAIN.replace(" ", ";"),
    "trailing commas": PLAIN.replace(" ", ",").replace("\n", ",\n"),
    "exponents": PLAIN.replace("0 0 1", "0e0 0.0 +1.0E+00"),
    "byte-order mark": "\ufeff" + PLAIN,
    "comments": "# made by hand\n// or not\n0 0 1\n1 0 2\n# half\n0 1 3\n1 1 4 # end\n",
    "header": "x y z\n" + PLAIN,
    "header with units, quotes and capitals": '"X [m]","Y (m)","Height (m)"\n' + PLAIN.replace(" ", ","),
    "header in another order": "id,z,y,x\n0,1,0,0\n1,2,0,1\n2,3,1,0\n3,4,1,1\n",
    "header in a comment": "//Y X Z\n0 0 1\n0 1 2\n1 0 3\n1 1 4\n",
    "header with words beside": "name,easting,northing,elevation\na,0,0,1\nb,1,0,2\nc,0,1,3\nd,1,1,4\n",
    "colours": "0 0 1 255 255 255\n1 0 2 0 0 0\n0 1 3 0 0 0\n1 1 4 9 9 9\n",
    "number of points": "4\n" + PLAIN,
    "blank and comment lines by the thousand": "\n \n# nothing\n// here\n" * 3000 + PLAIN.replace("\n", "\n\n#\n\t\n"),
    "decimal commas and semicolons": "0,0;0,0;1,0\n1;0;2\n0;1,0;3,00\n1;1;4\n",
    "decimal commas and blanks": "0,0 0,0 1,0\n1,0 0,0 2,0\n0,0 1,0 3,0\n1,0 1,0 4,0\n",
    "decimal commas and tabs": "0,0\t0,0\t1,0\n1,0\t0,0\t2,0\n0,0\t1,0\t3,0\n1,0\t1,0\t4,0\n",
    "decimal commas in quotes": '"0,0","0,0","1,0"\n"1,0","0,0","2,0"\n"0,0","1,0","3,0"\n"1,0","1,0","4,0"\n',
    "numbers in quotes": '"0","0","1"\n"1","0","2"\n"0","1","3"\n"1","1","4"\n',
    "exponents of Fortran": PLAIN.replace("0 0 1", "0.0D+00 0.0d0 0.1D+01").replace("1 1 4", "1 1 .4D1"),
    "trailing semicolons": PLAIN.replace(" ", ";").replace("\n", ";\n"),
    "trailing commas behind a header": "x,y,z,\n" + PLAIN.replace(" ", ",").replace("\n", ",\n"),
    "trailing blanks": PLAIN.replace("\n", "  \n"),
    "words for names": "Easting (m);Northing (m);Elevation (m a.s.l.)\n" + PLAIN.replace(" ", ";"),
    "coordinates for names": "X Coordinate,Y Coordinate,Z Coordinate\n" + PLAIN.replace(" ", ","),
    "coordinates for names and tabs": "X Coordinate\tY Coordinate\tZ Coordinate\n" + PLAIN.replace(" ", "\t"),
    "coordinates for names and blanks": "X Coordinate Y Coordinate Z Coordinate\n" + PLAIN,
    "units behind blanks": "X [m] Y [m] Z [m]\n" + PLAIN,
    "names with more words": "POINT_X,POINT_Y,Z_ground,nx,normal_z\n0,0,1,9,9\n1,0,2,9,9\n0,1,3,9,9\n1,1,4,9,9\n",
    "letters of the compass": "N E Z\n0 0 1\n0 1 2\n1 0 3\n1 1 4\n",
    "letters of the compass with heights": "E N H\n" + PLAIN,
    "letters of the compass in a comment": "# N E Z\n0 0 1\n0 1 2\n1 0 3\n1 1 4\n",
    "German names": "Rechtswert;Hochwert;Höhe\n" + PLAIN.replace(" ", ";"),
    "title before the header": "Survey of the quarry\n\nx y z\n" + PLAIN,
    "degrees beside metres": "lat,lon,x,y,z\n47,8,0,0,1\n47,8,1,0,2\n47,8,0,1,3\n47,8,1,1,4\n",
    "units below the names": "x,y,z\nm,m,m\n" + PLAIN.replace(" ", ","),
    "comments of other programs": "% made by hand\n! N E Z\n0 0 1\n0 1 2\n1 0 3\n1 1 4\n",
    "blanks around commas": "x , y , z\n" + PLAIN.replace(" ", " , "),
    "colours without names": "x y z\n0 0 1 255 255 255\n1 0 2 0 0 0\n0 1 3 0 0 0\n1 1 4 9 9 9\n",
    "another order of points": "1 1 4\n0 0 1\n0 1 3\n1 0 2\n",
}


@pytest.mark.parametrize("spelling", SPELLINGS)
@pytest.mark.parametrize("suffix", [".xyz", ".TXT", ".csv", ".pts"])
def test_text_is_read_however_it_is_spelled(tmp_path, spelling, suffix):
    path = tmp_path / f"site{suffix}"
    path.write_text(SPELLINGS[spelling], encoding="utf-8", newline="")
    assert read(path, grid=Grid(1.0, 1.0)).heights.tolist() == [[1, 2], [3, 4]]


@pytest.mark.parametrize(
    ("content", "line"),
    {
        "": "cannot be read as text: no line of it holds three numbers",
        "not a map\nat all\n": "cannot be read as text: no line of it holds three numbers",
        "0 0 1\n1 0\n": "cannot be read as a table of x, y, z: ",
        "0 0 1\n1 0 two\n": "cannot be read as a table of x, y, z: could not convert string 'two' to float64 at row 1",
        "0 0\n1 1\n": "cannot be read as text: no line of it holds three numbers",
        "0,0;1,5\n": "cannot be read as text: no line of it holds three numbers",
        "a,b,c\n1,2,3\n": "header = 'a,b,c': must name x, y, z (or easting, northing, elevation), or be left out",
        "x,y\n1,2,3\n": "header = 'x,y': must name x, y, z",
        "lat,lon,height\n1,2,3\n": "column 'lat': is in degrees; reproject it to metres",
        "9\n" + PLAIN: "points = 4: must be 9, as its first line says; it is cut short",
        "lat,lon,h\n47,8,3\n": "column 'lat': is in degrees; reproject it to metres",
        "x (deg),y (deg),z\n47,8,3\n": "column 'x (deg)': is in degrees; reproject it to metres",
        "# lon lat height\n1 2 3\n": "column 'lon': is in degrees; reproject it to metres",
        "x [ft],y [ft],z\n1,2,3\n": "column 'x [ft]': is in ft; must be in metres",
        "x y z\nft ft ft\n1 2 3\n": "column 'x [ft]': is in ft; must be in metres",
        "x y z\ndeg deg m\n1 2 3\n": "column 'x [deg]': is in degrees",
        "x y z\na b c\n1 2 3\n": "header = 'a,b,c': must name x, y, z",
        "x_ft y_ft z_ft\n1 2 3\n": "column 'x_ft': is in ft; must be in metres",
        "x,y,z [ft]\n1,2,3\n": "column 'z [ft]': has heights in units of 0.3048 m (ft); give that ",
        "x,y,z_mm\n1,2,3\n": "column 'z_mm': has heights in units of 0.001 m (mm); give that (--height-scale=0.001)",
        "x,y,z_ground,z_canopy\n1,2,3,4\n": "columns 'z_ground' and 'z_canopy': all name z: must be one",
        "Point Number X Y Z Code\n7 1 2 3 4\n": "header: names 6 columns, the first row has 5: must name each",
        '"x" "y" "z"\n"7" 0 0 1\n"9" 1 0 2\n': "header: names 3 columns, the first row has 4: must name each",
        "a b c\n1 2 3\n": "header = 'a,b,c': must name x, y, z",
        " ".join("1" * 30) + "\n": "columns = 30: is a matrix of heights, or has many columns and no header",
        "1 2 3 4\n1 2\n": "cannot be read as a table of x, y, z: ",
        "7 1 2 3\n8 1 2 3\n" + "".join(f"{n} 1 2 3\n" for n in range(9, 20)): "columns: the first counts the points",
        "1" * 2**21: "cannot be read as text: a line has more than 1048576 characters; a matrix of heights is given as",
        "3\nwater\nO 0 0 0\nH 0 1 0\nH 1 0 0\n": "header = 'water': must name x, y, z",
    }.items(),
)
def test_a_text_that_is_no_cloud_is_refused(tmp_path, content, line):
    path = tmp_path / "site.xyz"
    path.write_text(content)
    assert refusal(path).startswith(line)


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize("content", [b"", b"II*\0\xff\xfe", b"ply\n", b"LASF" + bytes(400), bytes(range(256)) * 9])
def test_bytes_that_are_no_cloud_are_refused(tmp_path, suffix, content):
    path = tmp_path / f"site{suffix}"
    path.write_bytes(content)
    assert line_of(path).startswith(("cannot be read as", "version = 0.0: must be 1.0 to 1.4"))


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "utf-16-le", "utf-16-be", "utf-32", "latin-1"])
@pytest.mark.parametrize("line", ["\n", "\r\n"])
def test_text_is_read_in_every_encoding(tmp_path, encoding, line):
    path = tmp_path / "site.dat"
    content = "# von Jürgen\nN E Z\n0 0 1\n0 1 2\n1 0 3\n1 1 4\n".replace("\n", line)
    path.write_bytes((content if encoding != "utf-16-be" else content.replace("ü", "u")).encode(encoding))
    assert read(path, grid=Grid(1.0, 1.0)).heights.tolist() == [[1, 2], [3, 4]]


@pytest.mark.parametrize("name", ["site", "site.dat", "site.asc", "site.grd", "site.xyz.old"])
def test_the_header_decides_under_any_name(tmp_path, name):
    heights = uneven(20, 24)
    path = write_text(tmp_path / name, points_of(heights, CELL, WEST, SOUTH)[:, [1, 0, 2]], header="N E Z")
    raster = read(path)
    np.testing.assert_array_equal(raster.heights, heights)
    assert raster.origin == (WEST, SOUTH)


def test_heights_in_another_unit_are_read_with_its_factor(tmp_path):
    heights = uneven(20, 24)
    path = write_text(tmp_path / "site.csv", points_of(heights, CELL), ",", "x,y,z (ft)")
    np.testing.assert_allclose(read(path, scale=0.3048).heights, 0.3048 * heights, rtol=0, atol=1e-9)


def test_classes_in_a_column_are_heard(tmp_path):
    heights = uneven(20, 24)
    points = points_of(heights, CELL)
    codes = np.where(np.arange(len(points)) < 40, 5, 2)[:, None]
    columns = np.hstack([points + [0, 0, 1] * (codes == 5), codes])
    path = write_text(tmp_path / "site.csv", columns, ",", "x,y,z,Class")
    raster = read(path)
    known = ~np.isnan(raster.heights)
    assert np.count_nonzero(known) == 440
    np.testing.assert_array_equal(raster.heights[known], heights[known])
    assert np.count_nonzero(~np.isnan(read(path, classes=(2, 5)).heights)) == 480
