--  Frames of the made-up sky that the unit test of C looks at, too.
--
--  SPDX-License-Identifier: MIT

with Ada.Command_Line;
with Ada.Text_IO;
with Interfaces;   use Interfaces;
with Interfaces.C; use Interfaces.C;
with Starcat;      use Starcat;
with System;       use System;

procedure Test_Starcat is
   type Recipe is record
      Method, Index_Bytes, N_Stars : Unsigned_32;
      Longest_Rad                  : Interfaces.C.double;
      Seed                         : Unsigned_64;
   end record with Convention => C;

   type Truth is record
      Count                : Unsigned_32;
      X, Y, Magnitudes     : aliased Real_Array (0 .. Max_Centroids - 1);
      Star                 : Rows;
      Of_Attitude          : Matrix;
      Q_Body_From_Icrs     : Quaternion;
   end record with Convention => C;

   function Sky_Image (Of_Sky : Recipe; Bytes : Address) return size_t
     with Import, Convention => C, External_Name => "sky_image";

   procedure Sky_Look
     (Opened           : Image;
      Lens             : Camera;
      State            : in out Unsigned_64;
      Noise_Px         : Interfaces.C.double;
      N_Spots, N_False : Unsigned_32;
      Seen             : out Truth)
     with Import, Convention => C, External_Name => "sky_look";

   Size_Of_Workspace : constant size_t
     with Import, Convention => C, External_Name => "size_of_workspace";
   Size_Of_Result : constant size_t
     with Import, Convention => C, External_Name => "size_of_result";
   Offset_Of_Covariance : constant size_t
     with Import, Convention => C, External_Name => "offset_of_covariance";
   Offset_Of_N_Shape : constant size_t
     with Import, Convention => C, External_Name => "offset_of_n_shape";
   Offset_Of_Star : constant size_t
     with Import, Convention => C, External_Name => "offset_of_star";
   Size_Of_Image : constant size_t
     with Import, Convention => C, External_Name => "size_of_image";
   Size_Of_Neighbours : constant size_t
     with Import, Convention => C, External_Name => "size_of_neighbours";

   type Rows_Of_Stars is array (0 .. 300) of Unsigned_32 with Convention => C;
   type Memory is array (1 .. 10_000) of Neighbour with Convention => C;

   type Words is array (1 .. 75_000) of Unsigned_64;

   Bytes   : Words := (others => 0);
   Size    : size_t;
   Opened  : Image;
   Lens    : Camera;
   Given   : Options;
   Work    : Workspace := (others => 0);
   Found   : Result;
   Seen    : Truth;
   State   : Unsigned_64 := 4;
   Good    : Natural := 0;
   Bad     : Unsigned_32 := 9;
   First   : Rows_Of_Stars := (others => 0);
   Around  : Memory;
   Table   : Neighbours;

   procedure Check (Holds : Boolean; What : String) is
   begin
      if not Holds then
         Ada.Text_IO.Put_Line ("not so: " & What);
         Ada.Command_Line.Set_Exit_Status (Ada.Command_Line.Failure);
      end if;
   end Check;

begin
   Check (Workspace'Size / 8 >= Size_Of_Workspace, "room for the workspace");
   Check (Found'Size / 8 = Size_Of_Result, "size of a result");
   Check (Found.Covariance_Rad2'Position = Offset_Of_Covariance
          and Found.N_Shape'Position = Offset_Of_N_Shape
          and Found.Star'Position = Offset_Of_Star, "fields of a result");
   Check (Image'Size / 8 = Size_Of_Image, "size of an image");
   Check (Neighbours'Size / 8 = Size_Of_Neighbours, "size of a table");
   Check (Neighbour'Size = 32, "size of a neighbour");
   Check (Version_Number >= 200, "the version");
   Check (Open_Image (Opened, Bytes'Address, 512) = E_Magic, "zeros are no image");

   Size := Sky_Image ((1, 2, 300, 0.42, 8), Bytes'Address);
   Check (Open_Image (Opened, Bytes'Address, Size) = Ok, "it opens");
   Check (Opened.N_Stars = 300, "it has 300 stars");
   Check (Scrub_Image (Bytes'Address, Size, 0, 2, Bad) = Ok and Bad = 0,
          "it is sound");
   Table := (0.475, 0, 0, First'Address, Null_Address);
   Check (List_Neighbours (Opened, Work, Table) = E_Capacity, "no memory");
   Check (First (300) in 300 .. Around'Length, "how many neighbours");
   Table.Capacity := First (300);
   Table.Neighbour := Around'Address;
   Check (List_Neighbours (Opened, Work, Table) = Ok, "a table");
   Check (Opened.Neighbours_Of = Null_Address, "no table yet");
   Opened.Neighbours_Of := Table'Address;
   Check (Get_Camera (Opened, Lens) = Ok, "the camera");
   Check (Set_Default_Options (Given) = Ok, "the options");
   Given.Noise_Px := 0.3;
   for N in 1 .. 20 loop
      Sky_Look (Opened, Lens, State, 0.2, 12, 0, Seen);
      declare
         Spots : constant Frame :=
           (Seen.Count, Seen.X'Address, Seen.Y'Address, others => <>);
      begin
         if Identify_Frame (Opened, Lens, Given, Spots, Work, Found)
           = Identified
         then
            Good := Good + 1;
            for K in 0 .. Integer (Seen.Count) - 1 loop
               Check (Found.Star (K) = Seen.Star (K), "the star");
            end loop;
         end if;
         Check (Track_Frame (Opened, Lens, Given, Spots,
                             Seen.Q_Body_From_Icrs, 0.01, Work, Found)
                  = Identified, "it is tracked");
      end;
   end loop;
   Check (Good >= 18, "18 of 20 frames are identified");
   Ada.Text_IO.Put_Line ("test-ada: identified" & Good'Image & " of 20 frames");
end Test_Starcat;
