--  The C library as it is, for Ada 2012: a thin binding. starcat.h says what
--  each field is and what each function does.
--
--  Max_Centroids, Max_Stars and Suffix are those that the library was compiled
--  with; with others the program does not link.
--
--  SPDX-License-Identifier: MIT

with Interfaces;
with Interfaces.C;
with System;

package Starcat is
   use Interfaces;
   use type Interfaces.C.int;

   Max_Centroids : constant := 64;
   Max_Stars     : constant := 192;
   Suffix        : constant String := "_64_192_double";
   subtype Real is Interfaces.C.double;

   subtype Status is Interfaces.C.int;
   Ok                   : constant Status := 0;
   Identified           : constant Status := 0;
   No_Match             : constant Status := 1;
   Too_Few_Stars        : constant Status := 2;
   Incomplete           : constant Status := 3;
   E_Null               : constant Status := -1;
   E_Short              : constant Status := -2;
   E_Magic              : constant Status := -3;
   E_Version            : constant Status := -4;
   E_Byte_Order         : constant Status := -5;
   E_Alignment          : constant Status := -6;
   E_Layout             : constant Status := -7;
   E_Crc                : constant Status := -8;
   E_Capacity           : constant Status := -9;
   E_Too_Many_Centroids : constant Status := -10;
   E_Not_Finite         : constant Status := -11;
   E_Camera             : constant Status := -12;
   E_Options            : constant Status := -13;
   E_Budget             : constant Status := -14;

   type Real_Array is array (Natural range <>) of aliased Real
     with Convention => C;
   --  X, Y, Z, W of an attitude: the head of starcat.h has its matrix and an
   --  example.
   type Quaternion is array (0 .. 3) of Real with Convention => C;
   type Matrix is array (0 .. 8) of Real with Convention => C;
   type Shape_Terms is array (0 .. 5) of Real with Convention => C;
   type Rows is array (0 .. Max_Centroids - 1) of Integer_32
     with Convention => C;

   type Scales is array (1 .. 8) of Real with Convention => C;
   type Numbers is array (1 .. 6) of Unsigned_32 with Convention => C;
   type Addresses is array (1 .. 6) of System.Address with Convention => C;

   --  A neighbour of a star, and the neighbours of all stars: the addresses of
   --  N_Stars + 1 numbers of Unsigned_32, and of Capacity neighbours.
   type Neighbour is record
      Apart           : Unsigned_16;
      Turn, Magnitude : Unsigned_8;
   end record with Convention => C;

   type Neighbours is record
      Radius_Rad        : Real;
      Capacity, N_Stars : Unsigned_32;
      First             : System.Address;
      Neighbour         : System.Address;
   end record with Convention => C;

   --  An image in place, filled in by Open_Image. Neighbours_Of is Null_Address
   --  then; with the address of a table that List_Neighbours has filled in,
   --  frames that triangles do not solve are solved by votes.
   type Image is record
      Bytes                    : System.Address;
      Total_Bytes, Data_Bytes  : Unsigned_32;
      Method, N_Stars          : Unsigned_32;
      Others_Of_Image          : Numbers;
      Of_Image                 : Scales;
      Directions, Magnitudes   : System.Address;
      Star_Ids                 : System.Address;  --  Integer_64, by row
      Tables                   : Addresses;
      Neighbours_Of            : System.Address;
   end record with Convention => C;

   type Camera is record
      Width_Px, Height_Px, Focal_Length_Px : Real;
      X0_Px, Y0_Px                         : Real;
      K1, K2, K3, P1, P2                   : Real;
      Fold_Radius                          : Real;
   end record with Convention => C;

   type Options is record
      Tolerance_Px, Noise_Px, Noise_Mag : Real;
      Log_Chance, Fov_Error             : Real;
      Max_Steps                         : Unsigned_32;
   end record with Convention => C;

   --  Addresses of arrays of Count numbers; Null_Address where not known.
   type Frame is record
      Count                : Unsigned_32;
      X_Px, Y_Px           : System.Address;
      Magnitudes, Sigma_Px : System.Address := System.Null_Address;
   end record with Convention => C;

   type Result is record
      Q_Body_From_Icrs   : Quaternion;
      Of_Attitude        : Matrix;
      Residual_Rad       : Real;
      Log_Chance         : Real;
      N_Matched          : Unsigned_32;
      Steps              : Unsigned_32;
      N_Tried            : Unsigned_32;
      Focal_Length_Px    : Real;
      Reason             : Unsigned_32;
      N_Usable           : Unsigned_32;
      Best_N_Matched     : Unsigned_32;
      Best_Log_Chance    : Real;
      Best_Share         : Real;
      Covariance_Rad2    : Matrix;
      Reduced_Chi_Square : Real;
      Shape              : Shape_Terms;
      N_Shape            : Unsigned_32;
      Star               : Rows;
   end record with Convention => C;

   --  What a call works in: as many bytes as starcat_workspace has, or a few
   --  more. A library-level variable; a task needs its own.
   Real_Bytes : constant := Real'Size / 8;
   Work_Bytes : constant :=
     6_400 + 600 * Real_Bytes
     + Max_Centroids * (72 + 23 * Real_Bytes)
     + Max_Stars * (8 + 6 * Real_Bytes);
   type Workspace is array (0 .. Work_Bytes / 8) of Unsigned_64
     with Convention => C;

   function Version_Number return Unsigned_32
     with Import, Convention => C, External_Name => "starcat_version_number";

   function Open_Image
     (Opened : out Image;
      Bytes  : System.Address;
      Size   : Interfaces.C.size_t;
      Flags  : Unsigned_32 := 0) return Status
     with Import, Convention => C, External_Name => "starcat_open_image" & Suffix;

   function Scrub_Image
     (Bytes        : System.Address;
      Size         : Interfaces.C.size_t;
      First, Count : Unsigned_32;
      Bad_Block    : out Unsigned_32) return Status
     with Import, Convention => C, External_Name => "starcat_scrub_image";

   function Get_Camera (Opened : Image; Built_For : out Camera) return Status
     with Import, Convention => C,
          External_Name => "starcat_get_camera" & Suffix;

   function Set_Default_Options (Given : out Options) return Status
     with Import, Convention => C,
          External_Name => "starcat_set_default_options" & Suffix;

   function List_Neighbours
     (Opened : Image;
      Work   : in out Workspace;
      Table  : in out Neighbours) return Status
     with Import, Convention => C,
          External_Name => "starcat_list_neighbours" & Suffix;

   function Identify_Frame
     (Opened : Image;
      Lens   : Camera;
      Given  : Options;
      Seen   : Frame;
      Work   : in out Workspace;
      Found  : in out Result) return Status
     with Import, Convention => C,
          External_Name => "starcat_identify_frame" & Suffix;

   function Track_Frame
     (Opened          : Image;
      Lens            : Camera;
      Given           : Options;
      Seen            : Frame;
      Q_Prior         : Quaternion;
      Uncertainty_Rad : Real;
      Work            : in out Workspace;
      Found           : in out Result) return Status
     with Import, Convention => C, External_Name => "starcat_track_frame" & Suffix;

   --  Body_Of and Icrs are the addresses of Count rows of three numbers.
   function Fit_Attitude
     (Body_Of, Icrs    : System.Address;
      Count            : Unsigned_32;
      Q_Body_From_Icrs : out Quaternion) return Status
     with Import, Convention => C,
          External_Name => "starcat_fit_attitude" & Suffix;

end Starcat;
