using System;
using System.Collections.Generic;

namespace IrisSession.Core.Tests
{
    internal static class Hostile
    {
        /// <summary>Return bytes with a few changes, as a stranger or a bad link makes them.</summary>
        public static byte[] Mutate(byte[] bytes, Random random)
        {
            List<byte> changed = new List<byte>(bytes);
            for (int n = random.Next(1, 4); n > 0; n--)
            {
                int at = random.Next(changed.Count + 1);
                switch (random.Next(6))
                {
                    case 0: changed.Insert(at, (byte)random.Next(256)); break;
                    case 1: if (at < changed.Count) changed.RemoveAt(at); break;
                    case 2: if (at < changed.Count) changed[at] = (byte)(changed[at] ^ (1 << random.Next(8))); break;
                    case 3: changed.RemoveRange(at, Math.Min(random.Next(1, 30), changed.Count - at)); break;
                    default: if (at < changed.Count) changed[at] = (byte)random.Next(256); break;
                }
            }
            return changed.ToArray();
        }
    }
}
