"""Columns by their names: the meaning counts, north is y; what could be two columns is refused."""

import pytest

from processor.column_names import AmbiguousNamesError, coordinates


@pytest.mark.parametrize(
    ("header", "columns", "units"),
    [
        ("Intensity,Points:0,Points:1,Points:2", (1, 2, 3), ""),
        ("Points_0,Points_1,Points_2", (0, 1, 2), ""),
        ("Point.X,Point.Y,Point.Z,Scan", (0, 1, 2), ""),
        ("XCoord,YCoord,ZCoord", (0, 1, 2), ""),
        ("X,Y,Z,NormalX,NormalY,NormalZ", (0, 1, 2), ""),
        ("x,y,z,e,n", (0, 1, 2), ""),
        ("x,y,z,Height", (0, 1, 2), ""),
        ("X,Y,H", (0, 1, 2), ""),
        ("X [mm],Y [mm],Z [mm]", (0, 1, 2), "mm"),
        ("x_mm,y_mm,z_mm", (0, 1, 2), "mm"),
        ("Easting (US ft),Northing (US ft),Z (us-ft)", (0, 1, 2), "us-ft"),
        ("Point,Northing (m),Easting (m),Height (m)", (2, 1, 3), "m"),
        ("N,E,RL", (1, 0, 2), ""),
        ("Rechtswert,Hochwert,Höhe", (0, 1, 2), ""),
        ("Hochwert (X),Rechtswert (Y),Hoehe", (1, 0, 2), ""),
        ("点号,北坐标(X),东坐标(Y),高程", (2, 1, 3), ""),
        ("北,东,高", (1, 0, 2), ""),
        ("Ｘ坐标（毫米）,Ｙ坐标（毫米）,Ｚ坐标（毫米）", (0, 1, 2), "mm"),
        ("Nord,Est,Quota", (1, 0, 2), ""),
        ("Este,Norte,Elevación", (0, 1, 2), ""),
        ("Est,Nord,Altitude", (0, 1, 2), ""),
    ],
)
def test_coordinates_are_the_columns_whose_names_mean_them(header, columns, units):
    named = coordinates(header.split(","))
    assert (named.columns, set(named.units)) == (columns, {units})


@pytest.mark.parametrize(
    "header",
    [
        "range,theta,phi",
        "lon,lat,height",
        "nx,ny,nz",
        "Normals:0,Normals:1,Normals:2",
        "x1,y1,z1",
        "x,northing,z",
        "X (yd),Y (yd),Z (yd)",
        "East Z,North Z,Z",
        "x,y,intensity",
        "N,X,Height",
    ],
)
def test_other_names_are_no_coordinates(header):
    assert coordinates(header.split(",")) is None


@pytest.mark.parametrize("header", ["X,Y,Z,Easting,Northing,Height", "Easting,Northing,Height,Elevation", "x,x,y,z"])
def test_names_of_two_columns_for_one_axis_are_refused(header):
    with pytest.raises(AmbiguousNamesError, match="one column each of x, y, z"):
        coordinates(header.split(","))
