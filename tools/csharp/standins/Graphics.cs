// What the engine draws: renderers, and calls of one frame; buffers of the graphics card.
using System;
using System.Collections.Generic;
using System.Runtime.InteropServices;
using Standins;
using UnityEngine.Rendering;

namespace UnityEngine
{
    public class Renderer : Component
    {
        public bool enabled { get; set; } = true;

        public Material sharedMaterial { get; set; }

        public ShadowCastingMode shadowCastingMode { get; set; } = ShadowCastingMode.On;

        public bool receiveShadows { get; set; } = true;

        internal MaterialPropertyBlock Block { get; private set; }

        /// <summary>The engine copies the block; here it must not be changed afterwards.</summary>
        public void SetPropertyBlock(MaterialPropertyBlock properties) { Block = properties; }
    }

    public class MeshRenderer : Renderer
    {
    }

    public sealed class GraphicsBuffer : IDisposable
    {
        private readonly byte[] bytes;
        private readonly Target kind;
        private readonly int size;

        public GraphicsBuffer(Target target, int count, int stride)
        {
            Engine.CheckThread();
            if (count <= 0 || stride <= 0 || stride % 4 != 0) throw new ArgumentException("a buffer of " + count + " times " + stride + " bytes");
            kind = target;
            size = stride;
            bytes = new byte[count * stride];
            Live++;
        }

        [Flags]
        public enum Target
        {
            Structured = 16,
            Raw = 32,
        }

        public int count { get { return bytes.Length / size; } }

        public int stride { get { return size; } }

        public Target target { get { return kind; } }

        /// <summary>Buffers that were made and not disposed of.</summary>
        internal static int Live { get; private set; }

        internal bool IsDisposed { get; private set; }

        internal byte[] Bytes { get { return bytes; } }

        /// <summary>Starts and count are in elements of the array; the engine wants the same bytes of both.</summary>
        public void SetData(Array data, int managedBufferStartIndex, int graphicsBufferStartIndex, int count)
        {
            Engine.CheckThread();
            if (IsDisposed) throw new ObjectDisposedException("GraphicsBuffer");
            int item = Buffer.ByteLength(data) / Math.Max(data.Length, 1);
            if ((managedBufferStartIndex + count) * item > Buffer.ByteLength(data) || (graphicsBufferStartIndex + count) * item > bytes.Length)
            {
                throw new ArgumentException("beyond the buffer");
            }
            Buffer.BlockCopy(data, managedBufferStartIndex * item, bytes, graphicsBufferStartIndex * item, count * item);
        }

        public void Dispose()
        {
            if (!IsDisposed) Live--;
            IsDisposed = true;
        }
    }

    public struct RenderParams
    {
        public RenderParams(Material mat)
        {
            material = mat;
            matProps = null;
            worldBounds = default;
            layer = 0;
            shadowCastingMode = ShadowCastingMode.Off;
            receiveShadows = false;
        }

        public int layer { get; set; }

        public Bounds worldBounds { get; set; }

        public Material material { get; set; }

        public MaterialPropertyBlock matProps { get; set; }

        public ShadowCastingMode shadowCastingMode { get; set; }

        public bool receiveShadows { get; set; }
    }

    public class Graphics
    {
        /// <summary>Instances of one call, when each has a matrix and no more: the limit of the constant buffer.</summary>
        private const int MaxInstances = 1023;

        public static void RenderMeshInstanced<T>(in RenderParams rparams, Mesh mesh, int submeshIndex, T[] instanceData, int instanceCount = -1, int startInstance = 0) where T : unmanaged
        {
            Engine.CheckThread();
            if (!rparams.material.enableInstancing) throw new InvalidOperationException("the material has no instancing");
            int count = instanceCount < 0 ? instanceData.Length - startInstance : instanceCount;
            if (startInstance + count > instanceData.Length || count > MaxInstances) throw new ArgumentOutOfRangeException("instanceCount");
            if (!Engine.IsRecording) return;
            Matrix4x4[] matrices = new Matrix4x4[count];
            for (int i = 0; i < count; i++) matrices[i] = (Matrix4x4)(object)instanceData[startInstance + i];
            Engine.Draws.Add(new DrawCall { Material = rparams.material, Mesh = mesh, Matrices = matrices, Block = rparams.matProps });
        }

        public static void RenderPrimitives(in RenderParams rparams, MeshTopology topology, int vertexCount, int instanceCount = 1)
        {
            Engine.CheckThread();
            if (!Engine.IsRecording) return;
            Engine.Draws.Add(new DrawCall
            {
                Material = rparams.material,
                Topology = topology,
                Vertices = vertexCount,
                Block = rparams.matProps,
                Bounds = rparams.worldBounds,
            });
        }
    }
}

namespace Standins
{
    /// <summary>One draw call.</summary>
    public sealed class DrawCall
    {
        public UnityEngine.Material Material;

        /// <summary>Null for primitives without a mesh.</summary>
        public UnityEngine.Mesh Mesh;

        /// <summary>From the mesh to the world, one for each instance.</summary>
        public UnityEngine.Matrix4x4[] Matrices = { UnityEngine.Matrix4x4.identity };
        public UnityEngine.MaterialPropertyBlock Block;
        public UnityEngine.MeshTopology Topology;
        public int Vertices;
        public UnityEngine.Bounds Bounds;
        public string Name = "";

        internal static void AddRenderers(UnityEngine.GameObject one, List<DrawCall> draws)
        {
            UnityEngine.MeshRenderer renderer = one.GetComponent<UnityEngine.MeshRenderer>();
            UnityEngine.MeshFilter filter = one.GetComponent<UnityEngine.MeshFilter>();
            if (renderer == null || filter == null || filter.sharedMesh == null || !renderer.enabled || !one.activeInHierarchy) return;
            draws.Add(new DrawCall
            {
                Name = one.name,
                Material = renderer.sharedMaterial,
                Mesh = filter.sharedMesh,
                Matrices = new[] { one.transform.localToWorldMatrix },
                Block = renderer.Block,
            });
        }
    }
}
