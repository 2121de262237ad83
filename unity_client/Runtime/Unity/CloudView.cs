// A point cloud: its points go to a buffer of the graphics card as they came, and are placed and coloured there (IrisPoints.shader).
using System;
using IrisSession.Core;
using UnityEngine;

namespace IrisSession.Unity
{
    /// <summary>One cloud. Frames that are not larger than any before allocate nothing.</summary>
    public sealed class CloudView : IDisposable
    {
        /// <summary>Edge of a point that stands for itself [m].</summary>
        private const float PointM = 0.005f;

        /// <summary>Room for more points than a frame has, so that not every larger one needs a new buffer.</summary>
        private const float Spare = 1.25f;

        /// <summary>Corners of the two triangles of a point.</summary>
        private const int CornersAPoint = 6;

        /// <summary>Words of a point: x and y, z and colour.</summary>
        private const int WordsAPoint = 2;
        private const int WordBytes = 4;
        private const float ReachM = 1000f;
        public readonly string Name;
        private readonly Material material;
        private readonly MaterialPropertyBlock block = new MaterialPropertyBlock();
        private GraphicsBuffer buffer;
        private uint[] words = new uint[0];
        private Matrix4x4 T_world_lattice;
        private float edgeM;
        private long version = -1;
        private int limit = -1;

        public CloudView(string name, Material material)
        {
            Name = name;
            this.material = material;
        }

        /// <summary>Points that are drawn.</summary>
        public int Drawn { get; private set; }

        /// <summary>Take the newest frame, as many of its points as may be drawn: every beginning is a fair sample of the whole.</summary>
        public void Update(CloudStream stream, int maxPoints)
        {
            if (stream.Version == version && maxPoints == limit) return;
            version = stream.Version;
            limit = maxPoints;
            Cloud cloud = stream.Cloud;
            Drawn = Math.Min(cloud.Count, maxPoints);
            if (Drawn == 0) return;
            if (buffer == null || buffer.count < WordsAPoint * Drawn)
            {
                buffer?.Dispose();
                words = new uint[WordsAPoint * (int)(Spare * Drawn)];
                buffer = new GraphicsBuffer(GraphicsBuffer.Target.Structured, words.Length, WordBytes);
                block.SetBuffer(ShaderNames.Points, buffer);
            }
            Buffer.BlockCopy(cloud.Points, 0, words, 0, WordBytes * WordsAPoint * Drawn);
            buffer.SetData(words, 0, 0, WordsAPoint * Drawn);
            T_world_lattice = MakeLattice(cloud);
            // Points of surfaces: of fewer, each has more of the area.
            edgeM = (cloud.VoxelM > 0f ? cloud.VoxelM : PointM) * (float)Math.Sqrt((double)cloud.Count / Drawn);
        }

        /// <summary>Draw it in the world of the session, below `root`. Once a frame.</summary>
        public void Draw(Transform root)
        {
            if (Drawn == 0) return;
            block.SetMatrix(ShaderNames.LatticeToWorld, root.localToWorldMatrix * T_world_lattice);
            block.SetFloat(ShaderNames.PointSize, edgeM);
            RenderParams how = new RenderParams(material);
            how.matProps = block;
            how.worldBounds = new Bounds(root.position, new Vector3(ReachM, ReachM, ReachM));
            Graphics.RenderPrimitives(how, MeshTopology.Triangles, CornersAPoint * Drawn, 1);
        }

        public void Dispose()
        {
            buffer?.Dispose();
            buffer = null;
            Drawn = 0;
        }

        /// <summary>Return the matrix from nodes of the lattice, as the bytes number them, to the world in the engine's axes.</summary>
        private static Matrix4x4 MakeLattice(Cloud cloud)
        {
            Double3 origin = (double)cloud.StepM * new Double3(cloud.OriginX, cloud.OriginY, cloud.OriginZ);
            Float3 x = UnityAxes.ToUnity(new Double3(cloud.StepM, 0.0, 0.0));
            Float3 y = UnityAxes.ToUnity(new Double3(0.0, cloud.StepM, 0.0));
            Float3 z = UnityAxes.ToUnity(new Double3(0.0, 0.0, cloud.StepM));
            Float3 at = UnityAxes.ToUnity(origin);
            return new Matrix4x4(UnityValues.ToVector4(x, 0f), UnityValues.ToVector4(y, 0f), UnityValues.ToVector4(z, 0f), UnityValues.ToVector4(at, 1f));
        }
    }
}
