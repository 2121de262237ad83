// What the threads of the engine and of the session hand to each other. Neither ever waits for the other.
using System;
using System.Threading;

namespace IrisSession.Transport
{
    /// <summary>The newest of something that is written by one thread and read by another: three of it, exchanged.</summary>
    internal sealed class TripleBuffer<T> where T : class
    {
        private const int Fresh = 4;
        private readonly T[] slots;
        private int shared = 1; // index of the one in between, and whether it is fresh
        private int back;
        private int front = 2;

        public TripleBuffer(Func<T> make)
        {
            slots = new[] { make(), make(), make() };
        }

        /// <summary>Of the writer: what it fills next.</summary>
        public T Back { get { return slots[back]; } }

        /// <summary>Of the reader: what it took last.</summary>
        public T Front { get { return slots[front]; } }

        /// <summary>Of the writer: hand over what is in `Back`. Returns whether an older one was never read.</summary>
        public bool Publish()
        {
            int before = Interlocked.Exchange(ref shared, back | Fresh);
            back = before & 3;
            return (before & Fresh) != 0;
        }

        /// <summary>Of the reader: take the newest one as `Front`. False: it is that already.</summary>
        public bool TryTake()
        {
            if ((Volatile.Read(ref shared) & Fresh) == 0) return false;
            front = Interlocked.Exchange(ref shared, front) & 3;
            return true;
        }
    }

    /// <summary>A bounded queue from one thread to another. Its slots are made once, filled and read in place.</summary>
    internal sealed class HandOver<T>
    {
        private readonly T[] slots;
        private int added; // counts; written by one thread
        private int taken; // written by the other

        /// <param name="capacity">A power of two.</param>
        /// <param name="make">Makes the slots.</param>
        public HandOver(int capacity, Func<T> make)
        {
            slots = new T[capacity];
            for (int i = 0; i < capacity; i++) slots[i] = make();
        }

        /// <summary>Of the writer: whether there is room.</summary>
        public bool HasRoom { get { return added - Volatile.Read(ref taken) < slots.Length; } }

        /// <summary>Of the writer, while there is room: the slot to fill. Then call <see cref="Add"/>.</summary>
        public ref T Next { get { return ref slots[added & (slots.Length - 1)]; } }

        public void Add()
        {
            Volatile.Write(ref added, added + 1);
        }

        /// <summary>Of the reader: whether something waits.</summary>
        public bool HasNews { get { return Volatile.Read(ref added) != taken; } }

        /// <summary>Of the reader, while something waits: the oldest. Then call <see cref="Remove"/>.</summary>
        public ref T Oldest { get { return ref slots[taken & (slots.Length - 1)]; } }

        public void Remove()
        {
            Volatile.Write(ref taken, taken + 1);
        }
    }
}
