// Assets with the encoding `arrays`: containers to arrays. docs/scene.md is normative.
using System;
using System.Collections.Generic;

namespace IrisSession.Core
{
    /// <summary>One array of an asset.</summary>
    public sealed class DecodedArray
    {
        public readonly string Name;

        /// <summary>Entries along each axis, in C order.</summary>
        public readonly int[] Shape;

        /// <summary>A byte, sbyte, ushort, uint or float array.</summary>
        public readonly Array Data;

        internal DecodedArray(string name, int[] shape, Array data)
        {
            Name = name;
            Shape = shape;
            Data = data;
        }
    }

    /// <summary>Arrays by name. What an asset must hold is asked for by `Require`, which checks type and shape.</summary>
    public sealed class ArrayAsset
    {
        /// <summary>An axis of any length, in shapes that are asked for.</summary>
        public const int Any = -1;

        /// <summary>An `ArrayKind`.</summary>
        public readonly string Kind;

        /// <summary>Stated bound on the values, in their unit; 0: exact.</summary>
        public readonly double MaxError;
        private readonly Dictionary<string, DecodedArray> arrays;

        internal ArrayAsset(string kind, double maxError, Dictionary<string, DecodedArray> arrays)
        {
            Kind = kind;
            MaxError = maxError;
            this.arrays = arrays;
        }

        public int Count { get { return arrays.Count; } }

        /// <summary>Return an array, null when there is none.</summary>
        public DecodedArray Find(string name)
        {
            return arrays.TryGetValue(name, out DecodedArray array) ? array : null;
        }

        /// <summary>Return the floats of an array.</summary>
        /// <exception cref="DecodeException">It is missing, or has another type or shape.</exception>
        public float[] RequireFloats(string name, params int[] shape)
        {
            return Require(name, shape).Data as float[] ?? throw Unfit(name);
        }

        /// <summary>Return the bytes of an array.</summary>
        /// <exception cref="DecodeException">It is missing, or has another type or shape.</exception>
        public byte[] RequireBytes(string name, params int[] shape)
        {
            Array data = Require(name, shape).Data;
            return data.GetType() == typeof(byte[]) ? (byte[])data : throw Unfit(name); // `as` takes an sbyte[] for one
        }

        /// <summary>Return an array of u2 or u4 as indices below `limit`.</summary>
        /// <exception cref="DecodeException">It is missing, has another type or shape, or an index is too large.</exception>
        public int[] RequireIndices(string name, int limit, params int[] shape)
        {
            Array data = Require(name, shape).Data;
            int[] indices = new int[data.Length];
            if (data.GetType() == typeof(ushort[])) for (int i = 0; i < indices.Length; i++) indices[i] = ((ushort[])data)[i];
            else if (data.GetType() == typeof(uint[])) for (int i = 0; i < indices.Length; i++) indices[i] = (int)Math.Min(((uint[])data)[i], int.MaxValue);
            else throw Unfit(name);
            foreach (int index in indices) if (index >= limit) throw new DecodeException("the array " + name + " names " + index + " of " + limit);
            return indices;
        }

        private DecodedArray Require(string name, int[] shape)
        {
            DecodedArray array = Find(name) ?? throw new DecodeException("the array " + name + " is missing");
            bool fits = array.Shape.Length == shape.Length;
            for (int i = 0; fits && i < shape.Length; i++) fits = shape[i] == Any || shape[i] == array.Shape[i];
            return fits ? array : throw Unfit(name);
        }

        private DecodeException Unfit(string name)
        {
            DecodedArray array = arrays[name];
            return new DecodeException("the array " + name + " has the type " + array.Data.GetType().Name + " and the shape (" + string.Join(", ", array.Shape) + ")");
        }
    }
}
