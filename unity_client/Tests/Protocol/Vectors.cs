// The golden vectors of docs/protocol, which a tool writes as lines: tools/csharp/vectors.py.
using System;
using System.Collections.Generic;
using System.IO;
using System.Linq;
using System.Reflection;
using NUnit.Framework;

namespace IrisSession.Protocol.Tests
{
    public sealed class Vector
    {
        public string Type, Name;
        public bool IsRefused;

        /// <summary>Made from others by a tool.</summary>
        public bool IsDerived;
        public byte[] Bytes, Canonical;

        public override string ToString() { return Name; }
    }

    public static class Vectors
    {
        static List<Vector> all;

        public static List<Vector> All
        {
            get
            {
                if (all != null) return all;
                string folder = System.Environment.GetEnvironmentVariable("IRIS_VECTORS");
                if (folder == null) Assert.Ignore("the vectors are written by python -m tools.csharp test");
                return all = File.ReadLines(Path.Combine(folder, "messages.txt")).Select(line => line.Split('\t')).Select(row => new Vector
                {
                    IsRefused = row[0] == "refuses", Type = row[1], Bytes = Parse(row[2]), Canonical = Parse(row[3]), Name = row[1] + " " + row[4],
                    IsDerived = row[4].Contains(" = ") || row[4].Contains(", mutation") || row[4].EndsWith(" order"),
                }).ToList();
            }
        }

        static byte[] Parse(string digits)
        {
            byte[] bytes = new byte[digits.Length / 2];
            for (int i = 0; i < bytes.Length; i++) bytes[i] = Convert.ToByte(digits.Substring(2 * i, 2), 16);
            return bytes;
        }

        /// <summary>Return a new object of a type, by its name.</summary>
        public static WireValue Create(string type)
        {
            return (WireValue)Activator.CreateInstance(typeof(WireValue).Assembly.GetType("IrisSession.Protocol." + type, true));
        }

        /// <summary>Read what the bytes are said to be, and return what a writer makes of it.</summary>
        public static byte[] ReadAndWrite(string type, byte[] bytes, WireValue into = null)
        {
            var reader = new WireReader(bytes);
            var writer = new WireWriter();
            if (type == "PatchOp[]")
            {
                int n = reader.ReadArrayHeader();
                writer.WriteArrayHeader(n);
                for (; n > 0; n--) PatchOp.ReadAny(reader).WriteTo(writer);
            }
            else reader.ReadInto(into ?? Create(type)).WriteTo(writer);
            reader.ExpectEnd();
            return writer.ToArray();
        }
    }
}
