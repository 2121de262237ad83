using System;
using System.Globalization;
using System.Text;

/// <summary>Writes what was done, a line each: JSON or words.</summary>
internal sealed class Report
{
    private readonly bool isJson;

    public Report(bool isJson)
    {
        this.isJson = isJson;
    }

    /// <summary>Write a line.</summary>
    /// <param name="what">The command.</param>
    /// <param name="isDone">Whether it succeeded.</param>
    /// <param name="fields">Names and values in turn: texts, numbers, truths, arrays of texts.</param>
    public void Write(string what, bool isDone, params object[] fields)
    {
        StringBuilder line = new StringBuilder();
        line.Append(isJson ? "{\"command\": " + Quote(what) + ", \"ok\": " + (isDone ? "true" : "false") : what + (isDone ? ":" : " FAILED:"));
        for (int i = 0; i + 1 < fields.Length; i += 2)
        {
            line.Append(isJson ? ", " + Quote((string)fields[i]) + ": " : " " + fields[i] + "=");
            line.Append(Format(fields[i + 1]));
        }
        if (isJson) line.Append('}');
        lock (this)
        {
            Console.Out.WriteLine(line.ToString());
            Console.Out.Flush();
        }
    }

    private static string Format(object value)
    {
        switch (value)
        {
            case null: return "null";
            case bool truth: return truth ? "true" : "false";
            case double number: return double.IsNaN(number) || double.IsInfinity(number) ? "null" : number.ToString("0.######", CultureInfo.InvariantCulture);
            case string text: return Quote(text);
            case string[] texts: return "[" + string.Join(", ", Array.ConvertAll(texts, Quote)) + "]";
            case double[] numbers: return "[" + string.Join(", ", Array.ConvertAll(numbers, each => Format(each))) + "]";
            default: return Convert.ToString(value, CultureInfo.InvariantCulture);
        }
    }

    private static string Quote(string text)
    {
        StringBuilder quoted = new StringBuilder("\"");
        foreach (char unit in text)
        {
            if (unit == '"' || unit == '\\') quoted.Append('\\').Append(unit);
            else if (unit < ' ' || unit > '~') quoted.Append("\\u").Append(((int)unit).ToString("x4"));
            else quoted.Append(unit);
        }
        return quoted.Append('"').ToString();
    }
}
